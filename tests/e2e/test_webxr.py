"""The immersive session in an emulated Quest 3 (IWER): both eyes show the right part of the panorama."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import known_panorama
import pytest
from playwright.sync_api import Browser, Page
from processes import PROJECT
from running_service import Service
from scipy.spatial.transform import Rotation
from viewer_page import wait_playing, wait_until

pytestmark = pytest.mark.e2e

IWER = PROJECT / "node_modules/iwer/build/iwer.min.js"
WIDTH, HEIGHT = 960, 480
VERTICAL_FOV = math.pi / 2      # IWER's own
TOLERANCE = 20                  # 8-bit codes: H.264 and 4:2:0 on saturated colours
WAIT_MS = 30_000

INSTALL = """
(() => {
  // The test reads the canvas after the frame has been shown.
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return getContext.call(this, kind, { ...options, preserveDrawingBuffer: true });
  };
  const layers = %(layers)s;
  const features = [...IWER.metaQuest3.supportedFeatures, ...(layers ? ['layers'] : [])];
  window.device = new IWER.XRDevice({ ...IWER.metaQuest3, supportedFeatures: features }, { stereoEnabled: true });
  device.installRuntime({ polyfillLayers: layers, forceInstall: true });
})();
"""

# IWER replaces the layers polyfill's XRWebGLBinding by its own, which has no layers: keep the first one.
KEEP_BINDING = """
(() => {
  let binding;
  Object.defineProperty(window, 'XRWebGLBinding', { get: () => binding, set: (value) => { binding ??= value; } });
})();
"""
# A compositor sees every layer, the polyfill only what is in the WebGL context it composes in: make it the page's.
SHARE_CONTEXT = """
(() => {
  const create = XRMediaBinding.prototype.createEquirectLayer;
  XRMediaBinding.prototype.createEquirectLayer = function (...options) {
    return Object.assign(create.apply(this, options), { context: mr360.viewer.panorama.gl });
  };
})();
"""

READ_PIXELS = """
async (points) => {
  for (let i = 0; i < 4; i++) await new Promise(requestAnimationFrame);
  const canvas = document.querySelector('[data-webxr_runtime] canvas');
  const gl = canvas.getContext('webgl2');
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  const pixels = new Uint8Array(canvas.width * canvas.height * 4);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const colors = points.map(([x, y]) => [...pixels.slice(4 * (y * canvas.width + x), 4 * (y * canvas.width + x) + 3)]);
  return { width: canvas.width, height: canvas.height, colors };
}
"""


@dataclass(frozen=True)
class HeadPose:
    """Degrees, turned about Y by yaw (positive to the right), then X by pitch (up), then Z by roll (to the left)."""

    yaw: float
    pitch: float
    roll: float

    @property
    def rotation(self) -> Rotation:
        return Rotation.from_euler("YXZ", [-self.yaw, self.pitch, self.roll], degrees=True)


POSES = [HeadPose(0, 0, 0), HeadPose(100, 25, 0), HeadPose(-165, -35, 20)]


def pixels(page: Page, points: list[tuple[int, int]]) -> list[list[int]]:
    colors: list[list[int]] = page.evaluate(READ_PIXELS, points)["colors"]
    return colors


def open_viewer(browser: Browser, service: Service, *, layers: bool, before: str = "") -> Page:
    """A page that plays, with a headset; `before` runs after the runtime has been installed."""
    context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT})
    context.add_init_script(path=IWER)
    context.add_init_script(KEEP_BINDING if layers else "")
    context.add_init_script(INSTALL % {"layers": "true" if layers else "false"} + before)
    page = context.new_page()
    page.goto(f"{service.url}/view/live")
    page.wait_for_selector("#vr:enabled", timeout=WAIT_MS)
    return page


def enter_vr(page: Page, path: str) -> None:
    page.click("#vr")
    wait_until(page, "mr360.viewer.immersive.session !== null")
    assert page.evaluate("mr360.viewer.immersive.path") == path
    page.wait_for_selector("[data-webxr_runtime] canvas", timeout=WAIT_MS)


def set_pose(page: Page, pose: HeadPose, position: tuple[float, float, float]) -> None:
    page.evaluate("([p, q]) => { device.position.set(...p); device.quaternion.set(...q); }",
                  [position, pose.rotation.as_quat().tolist()])


def mismatches(page: Page, pose: HeadPose) -> tuple[list[str], int, int]:
    """Wrong pixels of both eyes, the number of pixels compared and of different colours among them."""
    points: list[tuple[int, int]] = []
    expected: list[tuple[int, int, int]] = []
    eye_width = WIDTH // 2
    for eye_x in (0, eye_width):
        for i in range(12):
            for j in range(12):
                x, y = round((i + 0.5) * eye_width / 12), round((j + 0.5) * HEIGHT / 12)
                screen_x, screen_y = 2 * (x + 0.5) / eye_width - 1, 2 * (y + 0.5) / HEIGHT - 1
                tangent = math.tan(VERTICAL_FOV / 2)
                ray = pose.rotation.apply([screen_x * tangent * eye_width / HEIGHT, screen_y * tangent, -1.0])
                color = known_panorama.color_at((float(ray[0]), float(ray[1]), float(ray[2])))
                if color is not None:
                    points.append((eye_x + x, y))
                    expected.append(color)
    answer: dict[str, Any] = page.evaluate(READ_PIXELS, points)
    assert (answer["width"], answer["height"]) == (WIDTH, HEIGHT)
    wrong = [f"at {point}: {seen}, expected {color}"
             for point, color, seen in zip(points, expected, answer["colors"], strict=True)
             if max(abs(a - b) for a, b in zip(color, seen, strict=True)) > TOLERANCE]
    return wrong, len(points), len(set(expected))


@pytest.mark.parametrize("path", ["draw", "layer"])
def test_both_eyes_show_the_panorama(browser: Browser, known_service: Service, path: str) -> None:
    page = open_viewer(browser, known_service, layers=path == "layer")
    try:
        enter_vr(page, path)
        for pose in POSES:
            # The panorama is infinitely far; the emulated layer is a sphere of 25 m, so there the head stays near.
            set_pose(page, pose, (3.0, 1.2, -2.0) if path == "draw" else (0.0, 1.6, 0.0))
            wrong, compared, colors = mismatches(page, pose)
            assert compared >= 60, pose
            assert colors >= 5, pose
            assert not wrong, (pose, wrong[:5], len(wrong))
    finally:
        page.context.close()


@pytest.mark.parametrize("layers", [False, True])
def test_leaving_vr_returns_to_the_page(browser: Browser, known_service: Service, layers: bool) -> None:
    page = open_viewer(browser, known_service, layers=layers)
    try:
        enter_vr(page, "layer" if layers else "draw")
        page.evaluate("mr360.viewer.immersive.exit()")
        wait_until(page, "mr360.viewer.immersive.session === null")
        assert page.inner_text("#vr") == "Enter VR"
        wait_playing(page)
        assert not page.evaluate("mr360.viewer.video.paused")
        enter_vr(page, "layer" if layers else "draw")     # and in again
    finally:
        page.context.close()


def test_a_video_paused_by_entering_plays_again(browser: Browser, known_service: Service) -> None:
    page = open_viewer(browser, known_service, layers=False, before="""
        const request = navigator.xr.requestSession;
        navigator.xr.requestSession = async function (...options) {
          document.getElementById('video').pause();   // what Vision Pro does
          return request.apply(this, options);
        };""")
    try:
        enter_vr(page, "draw")
        wait_until(page, "!mr360.viewer.video.paused")
    finally:
        page.context.close()


def test_a_recentred_headset_sees_forward(browser: Browser, known_service: Service) -> None:
    page = open_viewer(browser, known_service, layers=False)
    try:
        enter_vr(page, "draw")
        set_pose(page, HeadPose(130, 0, 0), (0.5, 1.6, 0.5))
        page.evaluate("device.recenter()")
        wrong, compared, _ = mismatches(page, HeadPose(0, 0, 0))
        assert compared >= 60
        assert not wrong, wrong[:5]
    finally:
        page.context.close()


@pytest.mark.parametrize("path", ["draw", "layer"])
def test_the_wearer_is_told_what_the_page_tells(browser: Browser, known_service: Service, path: str) -> None:
    page = open_viewer(browser, known_service, layers=path == "layer", before=SHARE_CONTEXT if path == "layer" else "")
    try:
        enter_vr(page, path)
        set_pose(page, POSES[1], (0.0, 1.6, 0.0))
        assert not mismatches(page, POSES[1])[0]
        row = round(HEIGHT / 2 * (1 - 0.45 / 2))        # 2 m ahead, 0.45 m down
        middles = (WIDTH // 4, WIDTH * 3 // 4)          # of the eyes
        page.evaluate("mr360.viewer.whep.close()")
        wait_until(page, "document.getElementById('status-title').textContent === 'Stopped'")
        for middle in middles:
            ends = pixels(page, [(middle + x, row) for x in (-75, 75)])
            assert max(map(max, ends)) < 70, ends       # dark ground over a bright panorama
            text = pixels(page, [(middle + x, row + y) for x in range(-30, 31) for y in range(-4, 5)])
            assert max(map(min, text)) > 150, max(text)
        assert len(mismatches(page, POSES[1])[0]) < 30, "the last picture does not stay around the panel"
        page.evaluate("mr360.viewer.whep.start()")
        wait_until(page, "document.getElementById('status-title').textContent === 'Live'")
        assert not mismatches(page, POSES[1])[0]
    finally:
        page.context.close()


def test_a_denied_session_is_told(browser: Browser, known_service: Service) -> None:
    page = open_viewer(browser, known_service, layers=False, before="""
        navigator.xr.requestSession = () => Promise.reject(new DOMException('no', 'NotAllowedError'));""")
    try:
        page.click("#vr")
        page.wait_for_selector("#note:visible", timeout=WAIT_MS)
        assert "not allowed" in page.inner_text("#note")
        assert page.evaluate("mr360.viewer.immersive.session") is None
        assert page.is_enabled("#vr")
    finally:
        page.context.close()


def test_a_layer_that_fails_is_drawn_instead(browser: Browser, known_service: Service) -> None:
    page = open_viewer(browser, known_service, layers=True, before="""
        XRMediaBinding.prototype.createEquirectLayer = () => { throw new Error('no equirect layers here'); };
        """)
    try:
        enter_vr(page, "draw")
        wrong, compared, _ = mismatches(page, HeadPose(0, 0, 0))
        assert compared >= 60
        assert not wrong, wrong[:5]
    finally:
        page.context.close()


def test_without_a_headset_the_button_is_off_and_says_why(browser: Browser, known_service: Service) -> None:
    context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT})
    try:
        page = context.new_page()
        page.goto(f"{known_service.url}/view/live")
        wait_playing(page)
        page.wait_for_selector("#vr-note:visible", timeout=WAIT_MS)
        assert "headset" in page.inner_text("#vr-note") or "WebXR" in page.inner_text("#vr-note")
        assert page.is_disabled("#vr")
    finally:
        context.close()


def test_iwer_is_installed() -> None:
    assert IWER.is_file(), f"{IWER.relative_to(PROJECT)} is missing, run npm ci"
