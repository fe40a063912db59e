"""The page `/docs`: the OpenAPI document as plain HTML. FastAPI's own page loads its script from a CDN, which a camera
network without internet cannot reach and our content security policy forbids."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html import escape
from typing import Any

STYLE_PATH = "/docs/style.css"
STYLE = """
:root { color-scheme: light dark; }
body { font: 1rem/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem; }
h3 { margin: 2rem 0 0; }
p { margin: 0.25rem 0; }
pre { overflow-x: auto; padding: 1rem; border: 1px solid #8886; border-radius: 0.5rem; }
"""


def api_reference(openapi: dict[str, Any]) -> str:
    return "\n".join((
        "<!doctype html>", '<html lang="en">', "<head>", '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(openapi['info']['title'])} API</title>",
        f'<link rel="stylesheet" href="{STYLE_PATH}">', "</head>", "<body>", "<main>",
        f"<h1>{escape(openapi['info']['title'])} {escape(openapi['info']['version'])}</h1>",
        f"<p>{escape(openapi['info'].get('description', ''))}</p>",
        '<p>For programs: <a href="/openapi.json">/openapi.json</a>.</p>',
        *_operations(openapi["paths"]),
        "<h2>Schemas</h2>", *_schemas(openapi.get("components", {}).get("schemas", {})),
        "</main>", "</body>", "</html>"))


def _operations(paths: dict[str, Any]) -> Iterator[str]:
    for path, methods in paths.items():
        for method, operation in methods.items():
            yield f"<h3><code>{method.upper()} {escape(path)}</code></h3>"
            yield f"<p>{escape(operation.get('description') or operation.get('summary', ''))}</p>"
            body = operation.get("requestBody", {}).get("content", {})
            for media_type, content in body.items():
                yield f"<p>Body: <code>{escape(media_type)}</code> {_schema_name(content.get('schema', {}))}</p>"
            statuses = ", ".join(status for status in operation["responses"] if status != "422")
            yield f"<p>Success: {escape(statuses)}</p>"


def _schema_name(schema: dict[str, Any]) -> str:
    name = schema.get("$ref", "").rpartition("/")[2]
    return f'<a href="#{escape(name)}">{escape(name)}</a>' if name else ""


def _schemas(schemas: dict[str, Any]) -> Iterator[str]:
    for name, schema in schemas.items():
        yield f'<h3 id="{escape(name)}">{escape(name)}</h3>'
        yield f"<pre>{escape(json.dumps(schema, indent=2))}</pre>"
