from __future__ import annotations

import re

import httpx
import pytest
from test_rest_scene import assert_problem


@pytest.mark.parametrize("path", ["/", "/view/live", "/control/live", "/docs"])
def test_pages(client: httpx.Client, path: str) -> None:
    response = client.get(path)
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    assert response.headers["cache-control"] == "no-cache"
    assert "default-src 'self'" in response.headers["content-security-policy"]
    # Nothing from elsewhere: a camera network has no internet.
    assert not re.findall(r"""(?:src|href)=["'](?:https?:)?//""", response.text)


@pytest.mark.parametrize("path", ["/", "/view/live", "/control/live", "/docs"])
def test_everything_a_page_names_is_there(client: httpx.Client, path: str) -> None:
    base = client.base_url.join(path)
    links = re.findall(r"""(?:src|href)=["']([^"'#]+)["']""", client.get(path).text)
    assert links
    for link in links:
        assert client.get(base.join(link)).status_code == 200, link


@pytest.mark.parametrize(("name", "content_type"), [
    ("style.css", "text/css; charset=utf-8"),
    ("view.js", "text/javascript; charset=utf-8"),
    ("icon.svg", "image/svg+xml"),
])
def test_static_files_have_their_type(client: httpx.Client, name: str, content_type: str) -> None:
    response = client.get(f"/web/{name}")
    assert response.headers["content-type"] == content_type
    assert response.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("name", [
    "none.js", "__init__.py", "..%2fserver%2fcli.py", "%2e%2e/pyproject.toml", ".hidden.js", "a%00.js", "style.css/",
    "x" * 300 + ".js"])
def test_nothing_else_is_served(client: httpx.Client, name: str) -> None:
    assert_problem(client.get(f"/web/{name}"), 404)


@pytest.mark.parametrize("page", ["view", "control"])
@pytest.mark.parametrize("accept", ["text/html,application/xhtml+xml,*/*;q=0.8", "*/*", "text/*;q=0.1, application/json", ""])
def test_a_person_with_a_mistyped_stream_gets_the_page(client: httpx.Client, page: str, accept: str) -> None:
    response = client.get(f"/{page}/none", headers={"Accept": accept})
    assert response.status_code == 404
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    assert "default-src 'self'" in response.headers["content-security-policy"]
    assert response.headers["vary"] == "Accept"
    assert response.text == client.get(f"/{page}/live").text


@pytest.mark.parametrize("page", ["view", "control"])
@pytest.mark.parametrize("accept", ["application/json", "application/problem+json, text/plain", "text/html;q=0, */*"])
def test_a_program_with_a_mistyped_stream_gets_a_problem(client: httpx.Client, page: str, accept: str) -> None:
    response = client.get(f"/{page}/none", headers={"Accept": accept})
    assert_problem(response, 404, "no stream 'none'")
    assert response.headers["vary"] == "Accept"


def test_no_page_has_a_script_or_style_of_its_own(client: httpx.Client) -> None:
    """The content security policy would keep it from working."""
    for path in ("/", "/view/live", "/control/live"):
        text = client.get(path).text
        assert not re.findall(r"<script(?![^>]*\bsrc=)|<style|\bstyle=|\bon\w+=", text), path


def test_reference_covers_the_contract(client: httpx.Client) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    expected = {
        "/api/streams": {"get", "post"}, "/api/streams/{stream}": {"get", "patch", "delete"},
        "/api/streams/{stream}/scene": {"get", "put"}, "/api/streams/{stream}/objects": {"get", "post"},
        "/api/streams/{stream}/objects/{object_id}": {"get", "patch", "delete"},
        "/api/assets": {"get", "post"}, "/api/assets/{name}": {"delete"},
        "/api/streams/{stream}/lights": {"get"}, "/api/streams/{stream}/snapshot.jpg": {"get"},
        "/api/streams/{stream}/stats": {"get"}, "/api/streams/{stream}/viewers": {"get"},
        "/api/streams/{stream}/outputs": {"get", "post"},
        "/api/streams/{stream}/outputs/{output}": {"get", "patch", "delete"}, "/api/streams/{stream}/playback": {"get"},
        "/whep/{stream}": {"post", "options"},
        "/whep/{stream}/{session_id}": {"patch", "delete"},
        "/healthz": {"get"}, "/readyz": {"get"}, "/metrics": {"get"}}
    assert {path: set(methods) for path, methods in paths.items()} == expected
    page = client.get("/docs").text
    for path in expected:
        assert path in page
