"""The shipped containers keep what is recorded and uploaded."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from server.config import load_settings

DOCKER = Path(__file__).parents[2] / "docker"


def image_environment() -> dict[str, str]:
    return dict(re.findall(r"(MR360_\w+)=(\S+)", (DOCKER / "Dockerfile").read_text()))


@pytest.mark.parametrize("compose", ["compose.yaml", "compose.nat.yaml"])
def test_recordings_and_assets_lie_in_volumes(compose: str) -> None:
    settings = load_settings({}, environment=image_environment())
    text = (DOCKER / compose).read_text()
    service = re.search(r"^  mr360:\n(?:(?:    .*)?\n)+", text, re.MULTILINE)
    assert service is not None
    mounted = dict(reversed(volume.split(":")) for volume in re.findall(r"[\w-]+:/(?!/)[^\s\",\]]+", service[0]))
    declared = re.findall(r"^  ([\w-]+):$", text[text.index("\nvolumes:"):], re.MULTILINE)
    for folder in (settings.recordings_dir, settings.assets_dir):
        assert mounted[str(folder)] in declared


def test_the_image_has_the_folders_with_the_service_as_owner() -> None:
    """A volume takes both from the image; without them it is root's, and nothing can be written."""
    dockerfile = (DOCKER / "Dockerfile").read_text()
    user, = re.findall(r"^USER (\S+)$", dockerfile, re.MULTILINE)
    made = re.search(rf"install -d -o {user} -g {user} (.*)", dockerfile)
    assert made is not None
    settings = load_settings({}, environment=image_environment())
    assert {str(settings.recordings_dir), str(settings.assets_dir)} <= set(made[1].split())
