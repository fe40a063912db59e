"""A file's JSON as pygltflib's document classes.

pygltflib's own decoder takes a third of a millisecond for each object, so that a stranger's few megabytes take minutes, and it
drops what it does not know.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from typing import Any

import pygltflib


class SchemaError(ValueError):
    """A part of the JSON is of another type than the schema says."""


@dataclasses.dataclass
class _Node(pygltflib.Node):    # type: ignore[misc]  # pygltflib has no types
    weights: list[float] | None = None


@functools.cache
def _nested(kind: Any) -> dict[str, tuple[Any, bool]]:
    """Of a document class, the members that are objects of another or (True) lists of them."""
    result: dict[str, tuple[Any, bool]] = {}
    for name, hint in typing.get_type_hints(kind).items():
        options = [hint, *typing.get_args(hint)]
        for option in options:
            inner = next(iter(typing.get_args(option)), None) if typing.get_origin(option) is list else option
            if dataclasses.is_dataclass(inner) or inner is pygltflib.Attributes:
                result[name] = (_Node if inner is pygltflib.Node else inner, inner is not option)
                break
    return result


def built(kind: Any, value: Any, part: str) -> Any:
    """The JSON value as an object of the class; members that are numbers, strings or lists of them stay as they are.

    Raises SchemaError, which names the part, where an object or a list is expected and is not there.
    """
    if not isinstance(value, dict):
        raise SchemaError(f"{part} is of another type than expected, an object")
    if kind is pygltflib.Attributes:
        return kind(**{name: index for name, index in value.items() if name.isupper()})
    nested = _nested(kind)
    members = {}
    for name in _names(kind) & value.keys():
        member = value[name]
        if name in nested and member is not None:
            inner, many = nested[name]
            if many and not isinstance(member, list):
                raise SchemaError(f"{part} {name} is of another type than expected, a list")
            member = ([built(inner, one, f"{part} {name} {index}") for index, one in enumerate(member)] if many
                      else built(inner, member, f"{part} {name}"))
        members[name] = member
    return kind(**members)


@functools.cache
def _names(kind: Any) -> frozenset[str]:
    return frozenset(field.name for field in dataclasses.fields(kind))
