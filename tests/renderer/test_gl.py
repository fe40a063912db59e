from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from renderer.gl import Context, ShaderError, load_shader


def test_a_missing_include_names_file_and_line(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("renderer.gl.resources.files", lambda package: tmp_path)
    (tmp_path / "a.glsl").write_text("// first\n#include \"gone.glsl\"\n")
    with pytest.raises(ShaderError, match=r"a.glsl:2: shader 'gone.glsl' does not exist"):
        load_shader("a.glsl")


def test_a_compile_error_names_file_and_line(context: Context, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("renderer.gl.resources.files", lambda package: tmp_path)
    (tmp_path / "part.glsl").write_text("float part() {\n    return nonsense;\n}\n")
    (tmp_path / "v.glsl").write_text("void main() { gl_Position = vec4(0.0); }\n")
    (tmp_path / "f.glsl").write_text('#include "part.glsl"\nout vec4 o;\nvoid main() { o = vec4(part()); }\n')
    with pytest.raises(ShaderError, match=r"part.glsl:2"):
        context.program("v.glsl", "f.glsl")


def test_an_include_is_resolved_once_however_deep(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("renderer.gl.resources.files", lambda package: tmp_path)
    (tmp_path / "c.glsl").write_text("const float C = 1.0;\n")
    (tmp_path / "b.glsl").write_text('#include "c.glsl"\n')
    (tmp_path / "a.glsl").write_text('#include "b.glsl"\n#include "c.glsl"\n')
    assert load_shader("a.glsl").text.count("const float C") == 1


def test_a_software_renderer_is_refused_where_a_gpu_is_required(context: Context) -> None:
    """In a process of its own: a second context would take the place of the one that the other tests draw with."""
    if not context.is_software:
        pytest.skip("this machine has a GPU")
    program = "from renderer.gl import Context; Context(require_gpu=True)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert "GLUnavailableError" in done.stderr
    assert "expected a GPU" in done.stderr


def test_a_foreign_thread_is_refused(context: Context) -> None:
    caught: list[BaseException] = []

    def use() -> None:
        try:
            context.assert_own_thread()
        except RuntimeError as error:
            caught.append(error)

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert "outside the thread" in str(caught[0])
