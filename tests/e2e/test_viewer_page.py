"""The viewer page against the real service: it plays, turns, tells what is going on, and comes back by itself."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import known_panorama
import pytest
from media_servers import NginxRtmp, Publisher
from playwright.sync_api import Browser, Page
from processes import Process
from running_service import Service
from viewer_page import wait_playing, wait_until

pytestmark = pytest.mark.e2e

TOLERANCE = 20      # 8-bit codes: H.264 and 4:2:0 on saturated colours

READ_CENTER = """
() => {   // in the task that draws it
  const { viewer } = mr360;
  viewer.render();
  const { gl } = viewer.panorama;
  const { width, height } = viewer.canvas;
  const color = new Uint8Array(4);
  gl.readPixels(Math.floor(width / 2), Math.floor(height / 2), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, color);
  return [...color.slice(0, 3)];
}
"""


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Call it as `open_page(url, width=…, height=…, script=…)`. Uncaught errors of the page fail the test."""
    contexts, errors = [], []

    def open_(url: str, width: int = 960, height: int = 600, script: str = "", phone: bool = False) -> Page:
        context = browser.new_context(viewport={"width": width, "height": height}, is_mobile=phone, has_touch=phone)
        contexts.append(context)
        context.add_init_script(script)
        page = context.new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(url)
        return page

    yield open_
    for context in contexts:
        context.close()
    assert not errors


def view(service: Service, look: str = "", stream: str = "live") -> str:
    return f"{service.url}/view/{stream}{look}"


def center_color(page: Page) -> list[int]:
    color: list[int] = page.evaluate(READ_CENTER)
    return color


def direction(yaw: float, pitch: float) -> tuple[float, float, float]:
    """Of a view, from degrees."""
    a, b = math.radians(yaw), math.radians(pitch)
    return math.cos(b) * math.sin(a), math.sin(b), -math.cos(b) * math.cos(a)


def degrees(page: Page, name: str) -> float:
    return math.degrees(page.evaluate(f"mr360.viewer.look.{name}"))


def title(page: Page) -> str:
    return page.inner_text("#status-title")


def wait_title(page: Page, expected: str, limit_s: float = 30.0) -> None:
    wait_until(page, f"document.getElementById('status-title').textContent === {expected!r}", limit_s)


# --- the picture -----------------------------------------------------------------------------------------------------


def test_the_middle_of_the_view_is_the_direction_in_the_address(open_page: Callable[..., Page],
                                                                known_service: Service) -> None:
    page = open_page(view(known_service, "#yaw=-75&pitch=22&fov=60"), 480, 320)
    wait_playing(page)
    wait_title(page, "Live")
    assert (degrees(page, "yaw"), degrees(page, "pitch"), degrees(page, "fov")) == pytest.approx((-75, 22, 60))
    page.evaluate("location.hash = 'yaw=105&pitch=-22'")
    wait_until(page, "mr360.viewer.look.yaw > 0")
    assert (degrees(page, "yaw"), degrees(page, "pitch"), degrees(page, "fov")) == pytest.approx((105, -22, 60))
    for yaw in range(-165, 180, 30):
        for pitch in (-67, -22, 22, 67):
            look = {"yaw": math.radians(yaw), "pitch": math.radians(pitch)}
            seen = page.evaluate(f"(look) => {{ mr360.viewer.look.set(look); return ({READ_CENTER})(); }}", look)
            expected = known_panorama.color_at(direction(yaw, pitch))
            assert expected is not None
            difference = max(abs(a - b) for a, b in zip(expected, seen, strict=True))
            assert difference <= TOLERANCE, (yaw, pitch, seen, expected)


def test_dragging_turns_the_picture_with_the_pointer(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service, "#yaw=15&pitch=20&fov=60"), width=900, height=600)
    wait_playing(page)
    page.mouse.move(450, 300)
    page.mouse.down()
    page.mouse.move(350, 350, steps=10)
    page.wait_for_timeout(200)      # at rest before it is let go, so no inertia
    page.mouse.up()
    per_pixel = math.degrees(2 * math.tan(math.radians(30)) / 600)
    assert degrees(page, "yaw") == pytest.approx(15 + 100 * per_pixel, abs=0.1)
    assert degrees(page, "pitch") == pytest.approx(20 + 50 * per_pixel, abs=0.1)


def test_a_flick_goes_on_and_comes_to_rest(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service, "#yaw=0&pitch=0&fov=60"))
    wait_playing(page)
    # All events in one task: on a busy machine a flick made from out here would be too slow to be one.
    released = page.evaluate("""() => {
      const { canvas, look } = mr360.viewer;
      const send = (type, clientX) =>
        canvas.dispatchEvent(new PointerEvent(type, { pointerId: 1, clientX, clientY: 300 }));
      send('pointerdown', 600);
      for (let x = 590; x >= 540; x -= 10) send('pointermove', x);
      send('pointerup', 540);
      return look.yaw;
    }""")
    assert math.degrees(released) == pytest.approx(60 * math.degrees(2 * math.tan(math.radians(30)) / 600), abs=0.1)
    wait_until(page, f"mr360.viewer.look.yaw > {released} + 0.1")
    wait_until(page, "mr360.viewer.look.update(0) === false")
    assert abs(page.evaluate("mr360.viewer.look.yaw")) < math.pi


def test_keys_turn_and_zoom(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service, "#yaw=0&pitch=0&fov=75"))
    wait_playing(page)
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    assert degrees(page, "yaw") > 2
    assert degrees(page, "pitch") > 2
    page.keyboard.press("+")
    assert degrees(page, "fov") < 70
    page.keyboard.down("ArrowLeft")     # held: it goes on turning
    wait_until(page, "mr360.viewer.look.yaw * 180 / Math.PI < -10")
    page.keyboard.up("ArrowLeft")


def test_the_wheel_zooms_within_limits(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service, "#fov=75"))
    wait_playing(page)
    page.mouse.move(480, 300)
    page.mouse.wheel(0, -300)
    wait_until(page, "mr360.viewer.look.fov * 180 / Math.PI < 70")
    for _ in range(6):
        page.mouse.wheel(0, 300)
    wait_until(page, "Math.abs(mr360.viewer.look.fov * 180 / Math.PI - 110) < 1e-6")


def test_a_phone_turned_in_the_hand_turns_the_picture(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service, "#yaw=40&pitch=0"), 390, 844, phone=True)
    wait_playing(page)
    page.click("#motion")
    page.wait_for_selector("#motion[aria-pressed=true]")
    turn = """([alpha, beta]) => {
      dispatchEvent(new DeviceOrientationEvent('deviceorientation', { alpha, beta, gamma: 0 }));
      const m = mr360.viewer.look.worldFromView;
      return [-m[6], -m[7], -m[8]];
    }"""
    assert page.evaluate(turn, [200, 90]) == pytest.approx(direction(40, 0), abs=1e-9)       # it goes on from there
    assert page.evaluate(turn, [110, 90]) == pytest.approx(direction(130, 0), abs=1e-9)      # a quarter to the right
    assert page.evaluate(turn, [110, 120]) == pytest.approx(direction(130, 30), abs=1e-9)    # and up
    page.click("#motion")
    page.wait_for_selector("#motion[aria-pressed=false]")
    assert (degrees(page, "yaw"), degrees(page, "pitch")) == pytest.approx((130, 30), abs=1e-6)


# --- the page --------------------------------------------------------------------------------------------------------


def test_statistics_on_demand(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service))
    wait_playing(page)
    assert page.is_hidden("#statistics")
    page.keyboard.press("i")
    wait_until(page, "/[1-9][\\d.]* fps/.test(document.getElementById('statistics').innerText)")
    assert "2048 × 1024" in page.inner_text("#statistics")
    page.click("#statistics-button")
    assert page.is_hidden("#statistics")


@pytest.mark.parametrize(("width", "height", "phone"), [(1440, 900, False), (390, 844, True), (320, 568, True)])
def test_everything_fits_on_the_screen(open_page: Callable[..., Page], known_service: Service, width: int, height: int,
                                       phone: bool) -> None:
    page = open_page(view(known_service), width, height, phone=phone)
    wait_playing(page)
    page.click("#statistics-button")
    assert page.evaluate("document.documentElement.scrollWidth") == width
    for box in page.evaluate("""[...document.querySelectorAll('button, .home, .status, #statistics')]
                                .filter((e) => e.offsetParent !== null || getComputedStyle(e).position === 'fixed')
                                .filter((e) => !e.hidden).map((e) => e.getBoundingClientRect().toJSON())"""):
        assert box["left"] >= 0, box
        assert box["right"] <= width, box
        assert box["top"] >= 0, box
        assert box["bottom"] <= height, box
    for button in page.query_selector_all("button:visible"):
        assert button.inner_text().strip()
        assert button.bounding_box()["height"] >= 44  # type: ignore[index]


def test_the_list_leads_to_the_viewer(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(known_service.url + "/")
    page.click("#streams a:has-text('live')")
    page.wait_for_url(view(known_service))
    wait_playing(page)


ONLY = """
    const capabilities = RTCRtpReceiver.getCapabilities;
    const prefer = RTCRtpTransceiver.prototype.setCodecPreferences;
    const known = (codecs) => codecs.filter(({ mimeType }) => /video.(%s|rtx)$/i.test(mimeType));
    RTCRtpReceiver.getCapabilities = (kind) => {
      const { codecs } = capabilities.call(RTCRtpReceiver, kind);
      return { codecs: kind === 'video' ? known(codecs) : codecs, headerExtensions: [] };
    };
    """     # what a browser without the others says of itself


def test_a_browser_without_h264_plays_vp8(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service, "#yaw=15&pitch=22"), script=ONLY % "VP8")
    wait_playing(page)
    wait_title(page, "Live")
    codecs = page.evaluate("""async () => {
      const stats = [...(await mr360.viewer.whep.peer.getStats()).values()];
      const codec = stats.find(({ type, kind }) => type === 'inbound-rtp' && kind === 'video').codecId;
      return stats.find(({ id }) => id === codec).mimeType;
    }""")
    assert codecs == "video/VP8"


def test_a_weak_device_gets_a_rendition_that_it_decodes(open_page: Callable[..., Page], known_service: Service) -> None:
    """A browser that says of pictures wider than 600 pixels that they would stutter."""
    script = """
      const ask = navigator.mediaCapabilities.decodingInfo.bind(navigator.mediaCapabilities);
      navigator.mediaCapabilities.decodingInfo = async (wanted) => (
        { ...await ask(wanted), supported: true, smooth: wanted.video.width <= 600 });
    """
    first = open_page(view(known_service))      # without a viewer there is no picture, and no sizes are known
    wait_playing(first)
    full = known_service.stream()["output"]["width"]
    page = open_page(view(known_service), script=script)
    wait_playing(page)
    assert page.evaluate("mr360.viewer.panorama.size[0]") == full // 2
    assert {viewer["rendition"] for viewer in known_service.request("GET", "/api/streams/live/viewers")} == {"full", "low"}


def test_a_browser_without_any_codec_of_ours_is_told(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service), script=ONLY % "AV1")
    wait_title(page, "No video in this browser")
    assert "video/AV1" in page.inner_text("#status-detail")


def test_sound_is_off_until_a_person_turns_it_on(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service))
    wait_playing(page)
    wait_until(page, "!document.getElementById('sound').hidden")
    assert page.evaluate("mr360.viewer.video.muted")
    assert page.get_attribute("#sound", "aria-pressed") == "false"
    page.click("#sound")
    assert not page.evaluate("mr360.viewer.video.muted")
    assert page.get_attribute("#sound", "aria-pressed") == "true"
    page.keyboard.press("m")
    assert page.evaluate("mr360.viewer.video.muted")
    wait_playing(page)


def test_an_insecure_page_says_that_vr_needs_https(open_page: Callable[..., Page], known_service: Service) -> None:
    page = open_page(view(known_service), script="""
        Object.defineProperty(window, 'isSecureContext', { value: false });""")
    wait_until(page, "document.getElementById('vr-note').textContent.includes('https')")
    assert page.is_disabled("#vr")


# --- what happens on the way -----------------------------------------------------------------------------------------


def test_the_page_comes_back_by_itself_when_the_service_does(open_page: Callable[..., Page], known_source: Path,
                                                             tmp_path: Path) -> None:
    service = Service(tmp_path, "--source", str(known_source))
    again = None
    try:
        service.wait_ready()
        page = open_page(view(service, "#yaw=15&pitch=22"))
        wait_playing(page)
        wait_title(page, "Live")
        picture = center_color(page)
        service.process.kill()
        wait_until(page, "['Server not reachable', 'Connection lost'].includes("
                         "document.getElementById('status-title').textContent)")
        assert "Reconnecting in" in page.inner_text("#status-detail")
        page.wait_for_timeout(1000)
        assert center_color(page) == picture    # the last one stays
        again = Process([sys.executable, "-m", "server.cli", "serve", "--host", "127.0.0.1", "--port",
                         str(service.port), "--source", str(known_source)], tmp_path / "again.log")
        wait_title(page, "Live", limit_s=90.0)
        wait_playing(page)
    finally:
        service.process.kill()
        service.http.close()
        if again is not None:
            again.stop()


def test_a_lost_source_is_told_and_its_return_too(open_page: Callable[..., Page], service: Service, clip: Path,
                                                  nginx_rtmp: NginxRtmp, publisher: Callable[..., Publisher]) -> None:
    camera = publisher(clip, nginx_rtmp.url("viewer-page"))
    service.create_stream("camera", nginx_rtmp.url("viewer-page"))
    page = open_page(view(service, stream="camera"))
    wait_playing(page)
    wait_title(page, "Live")
    camera.process.stop()
    wait_title(page, "Source lost", limit_s=60.0)
    assert "stands still" in page.inner_text("#status-detail")
    publisher(clip, nginx_rtmp.url("viewer-page"))
    wait_title(page, "Live", limit_s=60.0)
    wait_playing(page)


def test_a_stream_that_is_deleted_is_not_found(open_page: Callable[..., Page], service: Service) -> None:
    service.create_stream("gone", None, wait=False)
    page = open_page(view(service, stream="gone"))
    wait_title(page, "No source")
    assert service.http.delete("/api/streams/gone").status_code == 204
    wait_title(page, "Stream not found", limit_s=60.0)
    assert "no stream named “gone”" in page.inner_text("#status-detail")
    assert page.is_visible("#retry")


def test_a_full_server_lets_the_next_viewer_in_when_one_leaves(open_page: Callable[..., Page], known_source: Path,
                                                               tmp_path: Path) -> None:
    service = Service(tmp_path, "--source", str(known_source), environment={"MR360_MAX_VIEWERS": "1"})
    try:
        service.wait_ready()
        first = open_page(view(service))
        wait_playing(first)
        second = open_page(view(service))
        wait_title(second, "The server is full")
        assert "Reconnecting in" in second.inner_text("#status-detail")
        first.close()       # its DELETE makes room
        wait_until(second, "!document.getElementById('retry').hidden || mr360.viewer.whep.state === 'connected'")
        wait_title(second, "Live", limit_s=60.0)
    finally:
        service.stop()
