"""One GL context for the renderer's tests; a test that leaves a GL error behind fails."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from renderer.gl import Context
from server.bench.pipelines import Pipelines


@pytest.fixture(scope="session")
def shared_context() -> Iterator[Context]:
    context = Context()
    yield context
    context.release()


@pytest.fixture
def context(shared_context: Context) -> Iterator[Context]:
    assert shared_context.gl.error == "GL_NO_ERROR"
    yield shared_context
    assert shared_context.gl.error == "GL_NO_ERROR"


@pytest.fixture(scope="module")
def pipelines(shared_context: Context) -> Iterator[Pipelines]:
    kept = Pipelines(shared_context)
    yield kept
    kept.release()
