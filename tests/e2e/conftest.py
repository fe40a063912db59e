"""Fixtures with real parts: media servers, the service as a process, a publisher, a browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import known_panorama
import pytest
from browser_page import chromium_page
from headless_viewer import HeadlessViewer
from media_servers import NginxRtmp, Publisher, RtspServer
from PIL import Image
from playwright.sync_api import Browser, Page
from running_service import Service
from viewer_page import chromium

from server.demo.clip import demo_clip

CLIP_WIDTH, CLIP_FPS = 1024, 15


@pytest.fixture(scope="session")
def clip() -> Path:
    """The synthetic camera's loop of 30 s, 1024×512 at 15 fps."""
    return demo_clip(CLIP_WIDTH, CLIP_FPS)


@pytest.fixture(scope="session")
def nginx_rtmp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NginxRtmp]:
    server = NginxRtmp(tmp_path_factory.mktemp("nginx"))
    yield server
    server.process.stop()


@pytest.fixture(scope="session")
def rtsp_server(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RtspServer]:
    server = RtspServer(clip, tmp_path_factory.mktemp("rtsp"))
    yield server
    server.process.stop()


@pytest.fixture
def publisher(tmp_path: Path) -> Iterator[Callable[..., Publisher]]:
    """Call it as `publisher(file, url, loop=True)`; everything started is stopped at the end."""
    started: list[Publisher] = []

    def start(file: Path, url: str, loop: bool = True) -> Publisher:
        started.append(Publisher(file, url, tmp_path / f"publisher-{len(started)}.log", loop))
        return started[-1]

    yield start
    for one in started:
        one.process.stop()


@pytest.fixture
def start_service(tmp_path: Path) -> Iterator[Callable[..., Service]]:
    """Call it with arguments of `mr360 serve`. Each one has to end well on Ctrl-C."""
    started: list[Service] = []

    def start(*arguments: str, wait: bool = True) -> Service:
        service = Service(tmp_path, *arguments)
        started.append(service)
        if wait:
            service.wait_ready()
        return service

    yield start
    errors = [error for service in started if (error := _stopped(service))]
    assert not errors, "\n".join(errors)


@pytest.fixture
def service(start_service: Callable[..., Service]) -> Service:
    """`mr360 serve`, its stream `live` still without a source: `service.url`, `service.pull(URL)`, `service.log`."""
    return start_service()


@pytest.fixture(scope="module")
def shared_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The same for all tests of a module, which saves the start."""
    service = Service(tmp_path_factory.mktemp("service"))
    try:
        service.wait_ready()
        yield service
    finally:
        error = _stopped(service)
    assert not error, error


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Callable[[str], HeadlessViewer]]:
    """Call it with a base URL: joins its stream `live` over WHEP and decodes."""
    started: list[HeadlessViewer] = []

    def start(base_url: str) -> HeadlessViewer:
        started.append(HeadlessViewer(f"{base_url}/whep/live?rendition=full", tmp_path / f"viewer-{len(started)}.log"))
        return started[-1]

    yield start
    for one in started:
        one.process.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A headless Chromium for all tests of a module."""
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def known_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A panorama whose colour is known in every direction; see known_panorama."""
    source = tmp_path_factory.mktemp("source") / "known.png"
    Image.fromarray(known_panorama.picture()).save(source)
    return source


@pytest.fixture(scope="module")
def known_service(known_source: Path) -> Iterator[Service]:
    """The service with that panorama as its stream `live`."""
    running = Service(known_source.parent, "--source", str(known_source))
    try:
        running.wait_ready()
        yield running
    finally:
        running.stop()


@pytest.fixture
def page() -> Iterator[Page]:
    """A page in a fresh headless Chromium."""
    with chromium_page() as page:
        yield page


def _stopped(service: Service) -> str | None:
    print(f"--- {service.log.name}\n{service.process.output()[-3000:]}")
    try:
        if service.process.running():
            service.stop()
        service.http.close()
    except AssertionError as error:
        return str(error)
    return None
