"""Packages from node_modules/ in a browser that knows nothing of Node: every module as text, and a `require` of a few lines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from processes import PROJECT

NODE_MODULES = PROJECT / "node_modules"
LOAD = """
window.require = (() => {
  const sources = %s;
  const loaded = {};
  const require = (name) => {
    if (!(name in loaded)) {
      const module = { exports: {} };
      loaded[name] = module;
      new Function('module', 'exports', 'require', sources[name])(module, module.exports, require);
    }
    return loaded[name].exports;
  };
  return require;
})();
"""


def common_js(package: str) -> str:
    """A script that defines `require` for the package and all that it depends on."""
    sources: dict[str, str] = {}
    _collect(package, sources)
    return LOAD % json.dumps(sources)


def _collect(package: str, sources: dict[str, str]) -> None:
    if package in sources:
        return
    folder = NODE_MODULES / package
    described: dict[str, Any] = json.loads((folder / "package.json").read_text())
    sources[package] = _main(folder, described).read_text()
    for needed in described.get("dependencies", {}):
        _collect(needed, sources)


def _main(folder: Path, described: dict[str, Any]) -> Path:
    main = folder / described.get("main", "index.js")
    return main if main.is_file() else main.with_suffix(".js")
