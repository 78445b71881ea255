"""The HTML page that documents the HTTP interface, from its OpenAPI schema; works offline."""

from __future__ import annotations

import json
from html import escape
from typing import Any

POLICY = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
"""Content-Security-Policy of the page: it loads nothing and runs nothing."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
code, pre { font: 13px/1.4 ui-monospace, monospace }
pre { background: #8881; padding: .6rem; overflow-x: auto }
h2 { border-top: 1px solid #8886; padding-top: 1rem; font-size: 1.1rem }
b { font-family: ui-monospace, monospace }
td { padding: 0 1rem 0 0; vertical-align: top }
@media (prefers-color-scheme: dark) { body { background: #111; color: #ddd } a { color: #8bf } }
"""
_METHODS = ("get", "post", "delete")


def page_of(schema: dict[str, Any]) -> str:
    """Return an HTML page for an OpenAPI schema."""
    info = schema["info"]
    calls = [
        _call(path, method, item[method])
        for path, item in schema["paths"].items()
        for method in _METHODS
        if method in item
    ]
    models = schema.get("components", {}).get("schemas", {})
    bodies = [
        f'<h2 id="{escape(name)}">{escape(name)}</h2><p>{escape(model.get("description", ""))}</p>'
        f"<pre>{escape(json.dumps(model, indent=1, ensure_ascii=False))}</pre>"
        for name, model in sorted(models.items())
    ]
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>{escape(info['title'])}</title><style>{_STYLE}</style>"
        f"<h1>{escape(info['title'])}</h1>{_paragraphs(info.get('description', ''))}"
        '<p>For programs: <a href="/openapi.json">openapi.json</a></p>'
        f"{''.join(calls)}<h1>What is sent</h1>{''.join(bodies)}</html>"
    )


def _call(path: str, method: str, call: dict[str, Any]) -> str:
    takes = [_linked(call.get("requestBody", {}))] if "requestBody" in call else []
    takes += [f"<code>{escape(p['name'])}</code> ({p['in']})" for p in call.get("parameters", ())]
    rows = [
        f"<tr><td>{escape(status)}<td>{escape(answer['description'])} {_linked(answer)}"
        for status, answer in call["responses"].items()
    ]
    return (
        f"<h2><b>{method.upper()} {escape(path)}</b> {'&#128273;' * ('security' in call)}</h2>"
        f"{_paragraphs(call.get('description') or call.get('summary', ''))}"
        f"<p>{'Takes ' * bool(takes)}{', '.join(takes)}</p><table>{''.join(rows)}</table>"
    )


def _paragraphs(text: str) -> str:
    return "".join(f"<p>{escape(part)}</p>" for part in text.split("\n\n"))


def _linked(part: dict[str, Any]) -> str:
    """Return links to the models to which a part of the schema refers."""
    names = sorted({ref.rsplit("/", 1)[1] for ref in _references(part)})
    return ", ".join(f'<a href="#{escape(n)}">{escape(n)}</a>' for n in names)


def _references(part: Any) -> list[str]:
    if isinstance(part, dict):
        here = [part["$ref"]] if isinstance(part.get("$ref"), str) else []
        return here + [ref for value in part.values() for ref in _references(value)]
    if isinstance(part, list):
        return [ref for value in part for ref in _references(value)]
    return []
