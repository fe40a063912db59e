"""The control page against the real service: what is done on it is in the scene, what others do shows on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import known_panorama
import numpy as np
import pytest
from browser_page import video_pixels
from PIL import Image
from playwright.sync_api import Browser, Page
from processes import wait_for
from running_service import Service
from viewer_page import wait_until

pytestmark = pytest.mark.e2e

SCENE = "/api/streams/live/scene"
OBJECTS = "/api/streams/live/objects"
MODEL = Path(__file__).resolve().parents[2] / "renderer" / "models" / "builtin" / "teapot.glb"
WITHIN_S = 20.0


@pytest.fixture(scope="module")
def known_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The known panorama with a lamp in it."""
    source = tmp_path_factory.mktemp("source") / "known.png"
    picture = Image.fromarray(known_panorama.picture()).resize((1024, 512))
    picture.paste((255, 255, 255), (700, 100, 720, 120))
    picture.save(source)
    return source


@pytest.fixture
def open_control(browser: Browser, known_service: Service) -> Iterator[Callable[..., Page]]:
    """Call it as `open_control(stream=…, width=…, height=…)`, with an empty scene. What the page complains about on its
    console (uncaught errors, a violated CSP) fails the test."""
    contexts, complaints = [], []
    known_service.request("PUT", SCENE, {})

    def open_(stream: str = "live", width: int = 1440, height: int = 900) -> Page:
        context = browser.new_context(viewport={"width": width, "height": height})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(WITHIN_S * 1000)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda said: complaints.append(said.text) if "Content Security Policy" in said.text else None)
        page.goto(f"{known_service.url}/control/{stream}")
        return page

    yield open_
    for context in contexts:
        context.close()
    assert not complaints


def objects(service: Service) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = service.request("GET", OBJECTS)
    return found


def add(page: Page, mesh: str) -> None:
    page.select_option("#mesh", mesh)
    page.click("#add-button")
    page.wait_for_selector(".object[open]")


def part(name: str) -> str:
    return f".object [data-part={name}]"


def wait_object(service: Service, what: str, condition: Callable[[dict[str, Any]], bool]) -> None:
    wait_for(what, lambda: condition(objects(service)[0]), WITHIN_S)


def test_an_object_is_added_moved_coloured_and_deleted(open_control: Callable[..., Page], known_service: Service) -> None:
    page = open_control()
    wait_until(page, "document.getElementById('status-title').textContent === 'Live'")
    before = video_pixels(page, "#picture")
    assert before is not None
    assert before.shape == (512, 1024, 3)
    add(page, "box")
    (placed,) = objects(known_service)
    assert (placed["mesh"], placed["position"]) == ("box", [0, -1.1, -3])
    wait_for("box in the picture", lambda: changed_pixels(page, before) > 500, WITHIN_S)

    page.fill(part("x"), "-1.25")
    page.fill(part("z"), "-2")
    wait_object(known_service, "new position", lambda placed: placed["position"] == [-1.25, -1.1, -2])
    page.fill(part("base-color"), "#ff8000")
    wait_object(known_service, "linear colour", lambda placed: placed["material"] is not None
                and placed["material"]["base_color"] == pytest.approx([1.0, 0.21586, 0.0], abs=1e-4))
    page.focus(part("metallic"))
    page.keyboard.press("End")
    page.fill(part("emissive-color"), "#00ff00")
    page.fill(part("emissive-strength"), "2.5")
    wait_object(known_service, "emissive", lambda placed: placed["material"]["emissive"] == [0, 2.5, 0])
    page.uncheck(part("visible"))
    wait_object(known_service, "hidden", lambda placed: placed["visible"] is False)
    assert objects(known_service)[0]["material"]["metallic"] == 1
    assert objects(known_service)[0]["position"] == [-1.25, -1.1, -2]
    assert page.inner_text(part("mesh")) == "box, hidden"

    last = objects(known_service)
    page.click(part("delete"))
    page.wait_for_selector(".object", state="detached")
    assert objects(known_service) == []
    page.keyboard.press("Enter")        # the focus is on Undo
    page.wait_for_selector(".object")
    assert objects(known_service) == last


def changed_pixels(page: Page, before: np.ndarray[Any, Any]) -> int:
    now = video_pixels(page, "#picture")
    assert now is not None
    return int(np.count_nonzero(np.abs(now.astype(int) - before).max(axis=-1) > 40))


def test_what_the_service_refuses_is_said_beside_it_and_kept(open_control: Callable[..., Page],
                                                             known_service: Service) -> None:
    page = open_control()
    add(page, "sphere")
    page.fill(part("x"), "20000")
    page.wait_for_selector(f"{part('position-complaints')} p")
    said = page.inner_text(part("position-complaints"))
    detail = known_service.request("PATCH", f"{OBJECTS}/sphere-1", {"position": [20000, 0, 0]}, expect=422)["detail"]
    assert said == f"x: {detail}"
    assert "20000" in said
    assert page.get_attribute(part("x"), "aria-invalid") == "true"
    assert page.inner_text("#" + str(page.get_attribute(part("x"), "aria-describedby"))) == said

    page.fill(part("y"), "0.5")         # goes on beside the wrong one
    wait_object(known_service, "new y", lambda placed: placed["position"] == [0, 0.5, -3])
    assert page.input_value(part("x")) == "20000"
    page.fill(part("z"), "")
    page.press(part("z"), "Tab")
    assert "z: expected a number" in page.inner_text(part("position-complaints"))
    page.press(part("z"), "Escape")     # back to what the service has
    assert page.input_value(part("z")) == "-3"
    page.fill(part("x"), "2")
    wait_object(known_service, "new x", lambda placed: placed["position"] == [2, 0.5, -3])
    wait_until(page, "document.querySelector('[data-part=position-complaints]').childElementCount === 0")

    page.fill("#camera-height", "-1")
    page.wait_for_selector("#camera-complaints p")
    assert "camera_height" in page.inner_text("#camera-complaints")
    page.fill("#camera-height", "2.25")
    wait_for("camera height", lambda: known_service.request("GET", SCENE)["camera_height"] == 2.25, WITHIN_S)
    wait_until(page, "document.getElementById('camera-complaints').childElementCount === 0")
    assert [placed["id"] for placed in objects(known_service)] == ["sphere-1"]


def test_what_others_change_shows_but_not_over_what_is_being_typed(open_control: Callable[..., Page],
                                                                   known_service: Service) -> None:
    page = open_control()
    known_service.place(id="ball", mesh="sphere", position=[1, 2, 3])
    page.click(part("summary"))
    page.fill(part("x"), "")            # somebody is about to type
    known_service.request("PATCH", f"{OBJECTS}/ball", {
        "position": [4, 5, 6], "material": {"roughness": 0.25, "base_color": [1.0, 0.21586, 0.0]}})
    wait_until(page, f"document.querySelector('{part('y')}').value === '5'")
    assert page.input_value(part("x")) == ""
    assert page.input_value(part("roughness")) == "0.25"
    assert page.input_value(part("base-color")) == "#ff8000"
    page.type(part("x"), "7.5")
    wait_object(known_service, "x beside the others", lambda placed: placed["position"] == [7.5, 5, 6])
    known_service.request("PUT", SCENE, {"camera_height": 3})
    page.wait_for_selector(".object", state="detached")
    assert page.input_value("#camera-height") == "3"


def test_an_uploaded_model_keeps_its_materials_until_it_is_given_others(open_control: Callable[..., Page],
                                                                        known_service: Service) -> None:
    known_service.request("POST", "/api/assets?name=figure", content=MODEL.read_bytes(),
                          headers={"Content-Type": "model/gltf-binary"})
    page = open_control()
    page.wait_for_selector("#mesh option[value='asset:figure']", state="attached")
    add(page, "asset:figure")
    (placed,) = objects(known_service)
    assert (placed["id"], placed["position"], placed["material"]) == ("figure-1", [0, -1.6, -3], None)
    assert page.is_checked(part("own-material"))
    assert page.is_disabled(part("roughness"))
    page.uncheck(part("own-material"))
    wait_object(known_service, "material", lambda placed: placed["material"] is not None)
    page.wait_for_selector(f"{part('roughness')}:enabled")
    page.fill(part("roughness"), "0.75")
    wait_object(known_service, "roughness", lambda placed: placed["material"]["roughness"] == 0.75)
    page.check(part("own-material"))
    wait_object(known_service, "own material", lambda placed: placed["material"] is None)


def test_lights_and_times_are_listed(open_control: Callable[..., Page], known_service: Service) -> None:
    page = open_control()
    wait_until(page, "document.querySelectorAll('#lights tr').length > 1")
    direction = known_service.request("GET", "/api/streams/live/lights")["lights"][0]["direction"]
    assert f"{round(np.degrees(np.arctan2(direction[0], -direction[2])))}° right" in page.inner_text("#lights")
    updates = page.evaluate("""() => new Promise((resolve) => {
      let count = 0;
      const observer = new MutationObserver(() => { count += 1; });
      observer.observe(document.getElementById('lights'), { childList: true });
      setTimeout(() => { observer.disconnect(); resolve(count); }, 2000);
    })""")
    assert 1 <= updates <= 11
    wait_until(page, "document.querySelectorAll('#stages tr').length > 3")
    stages = known_service.stats()["stages_ms"]
    assert len(page.query_selector_all("#stages tr")) == 1 + len(stages)


def test_it_fits_a_phone_and_everything_has_a_name(open_control: Callable[..., Page], known_service: Service) -> None:
    page = open_control(width=390, height=844)
    known_service.place(id="n" * 64, mesh="box")
    page.click(part("summary"))
    page.fill(part("x"), "20000")
    page.wait_for_selector(f"{part('position-complaints')} p")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    unnamed = page.evaluate("""[...document.querySelectorAll('input, select, button, a')]
        .filter((node) => !(node.labels?.length || node.textContent.trim() && node.localName !== 'select' || node.ariaLabel))
        .map((node) => node.outerHTML)""")
    assert unnamed == []
    for box in page.evaluate("""[...document.querySelectorAll('input:not([type=checkbox]), select, button, summary')]
        .filter((node) => node.checkVisibility()).map((node) => node.getBoundingClientRect().toJSON())"""):
        assert box["height"] >= 44, box


@pytest.mark.parametrize("page_name", ["control", "view"])
def test_a_mistyped_stream_is_told_in_words(open_control: Callable[..., Page], known_service: Service,
                                            page_name: str) -> None:
    page = open_control("lvie")
    answer = page.goto(f"{known_service.url}/{page_name}/lvie")
    assert answer is not None
    assert answer.status == 404
    wait_until(page, "document.getElementById('status-title').textContent === 'Stream not found'")
    assert "no stream named “lvie”" in page.inner_text("#status-detail")
