"""The page at /docs, which shows the OpenAPI document in one self-contained HTML file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html import escape
from typing import Any

from service.errors.problems import BY_STATUS, KINDS, MEDIA_TYPE

SECURITY_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"

STYLE = """
:root { color-scheme: light dark; --ink: #1d2733; --soft: #5b6b7c; --line: #d9e0e7; --paper: #ffffff;
  --panel: #f5f7f9; --accent: #0b6bcb; --get: #1a7f4b; --post: #0b6bcb; --put: #9a5b00; --patch: #7a3fb5;
  --delete: #b42318; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4eaf0; --soft: #93a3b3; --line: #2d3843;
  --paper: #12181f; --panel: #1a222b; --accent: #6cb2ff; --get: #4cc38a; --post: #6cb2ff; --put: #e5a54b;
  --patch: #c193f0; --delete: #f28b82; } }
* { box-sizing: border-box; }
html { scroll-padding-top: 1rem; }
body { margin: 0; font: 15px/1.55 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  display: grid; grid-template-columns: 17rem minmax(0, 1fr); }
nav { position: sticky; top: 0; height: 100vh; overflow-y: auto; padding: 1.5rem 1rem 2rem 1.5rem;
  border-right: 1px solid var(--line); background: var(--panel); font-size: 13.5px; }
nav h2 { font-size: 11px; letter-spacing: .08em; text-transform: uppercase; color: var(--soft);
  margin: 1.3rem 0 .3rem; }
nav a { display: block; padding: .12rem 0; color: inherit; text-decoration: none; }
nav a:hover { color: var(--accent); }
main { padding: 2rem 3rem 6rem; max-width: 62rem; }
h1 { font-size: 1.7rem; margin: 0; } h1 small { font-size: .9rem; color: var(--soft); font-weight: normal; }
main > h2 { margin: 3rem 0 .5rem; padding-bottom: .3rem; border-bottom: 1px solid var(--line); }
article { border: 1px solid var(--line); border-radius: 8px; margin: 1.2rem 0; padding: 1rem 1.2rem; }
article h3 { margin: 0; font: 600 14.5px/1.5 ui-monospace, monospace; overflow-wrap: anywhere; }
article h4 { font-size: 11px; letter-spacing: .08em; text-transform: uppercase; color: var(--soft);
  margin: 1rem 0 .3rem; }
.method { display: inline-block; min-width: 4.2rem; font-weight: 700; }
.get { color: var(--get); } .post { color: var(--post); } .put { color: var(--put); }
.patch { color: var(--patch); } .delete { color: var(--delete); }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; }
td { border-top: 1px solid var(--line); padding: .3rem .8rem .3rem 0; vertical-align: top; }
td:first-child { white-space: nowrap; } .soft { color: var(--soft); }
code, pre { font: 12.5px/1.5 ui-monospace, monospace; }
pre { background: var(--panel); border: 1px solid var(--line); border-radius: 6px; padding: .7rem .9rem;
  overflow-x: auto; margin: .4rem 0; }
summary { cursor: pointer; color: var(--soft); }
@media (max-width: 800px) { body { display: block; } nav { position: static; height: auto; border: 0; }
  main { padding: 1.5rem; } }
"""

Json = dict[str, Any]


def page(document: Json) -> str:
    """The HTML page of an OpenAPI document."""
    groups: dict[str, list[tuple[str, str, Json]]] = {tag["name"]: [] for tag in document.get("tags", [])}
    for path, item in document["paths"].items():
        for method, operation in item.items():
            groups.setdefault(operation.get("tags", ["other"])[0], []).append((method, path, operation))
    info = document["info"]
    title = escape(info["title"])
    parts = [
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head><body>',
        f'<nav><a href="#top"><strong>{title}</strong></a>',
        *(_menu(name, operations) for name, operations in groups.items()),
        '<h2>reference</h2><a href="#problems">Problems</a><a href="openapi.json">openapi.json</a></nav>',
        f'<main id="top"><h1>{title} <small>{escape(info["version"])}</small></h1>',
        f"<p>{escape(info.get('summary', ''))}</p>{_prose(info.get('description', ''))}",
    ]
    described = {tag["name"]: tag.get("description", "") for tag in document.get("tags", [])}
    for name, operations in groups.items():
        parts.append(f"<h2>{escape(name.capitalize())}</h2>{_prose(described.get(name, ''))}")
        parts += [_operation(document, *operation) for operation in operations]
    parts += [_problems(), "</main></body></html>"]
    return "".join(parts)


def _menu(name: str, operations: list[tuple[str, str, Json]]) -> str:
    links = "".join(
        f'<a href="#{escape(operation["operationId"])}">{escape(operation["summary"])}</a>'
        for _, _, operation in operations
    )
    return f"<h2>{escape(name)}</h2>{links}"


def _prose(text: str) -> str:
    """Text as HTML paragraphs, with code where it has back-ticks."""
    paragraphs = []
    for paragraph in filter(None, text.split("\n\n")):
        pieces = escape(paragraph).split("`")
        paragraphs.append("".join(f"<code>{piece}</code>" if i % 2 else piece for i, piece in enumerate(pieces)))
    return "".join(f"<p>{paragraph}</p>" for paragraph in paragraphs)


def _operation(document: Json, method: str, path: str, operation: Json) -> str:
    rows = [_row(f"<code>{escape(p['name'])}</code>", _parameter(p)) for p in operation.get("parameters", [])]
    parts = [
        f'<article id="{escape(operation["operationId"])}"><h3><span class="method {method}">{method.upper()}</span>'
        f"{escape(path)}</h3>{_prose(str(operation.get('description', operation['summary'])))}",
        f"<pre>{escape(_curl(method, path, operation))}</pre>",
        _table("Parameters", rows),
    ]
    body = operation.get("requestBody", {}).get("content", {})
    parts.append(
        _table("Body", [_row(f"<code>{escape(kind)}</code>", _content(document, c)) for kind, c in body.items()])
    )
    answers = []
    for status, response in operation["responses"].items():
        if status == "default":
            continue
        shown = "".join(_content(document, c) for kind, c in response.get("content", {}).items() if kind != MEDIA_TYPE)
        answers.append(_row(f"<code>{escape(status)}</code>", escape(response["description"]) + shown))
    return "".join([*parts, _table("Answers", answers), "</article>"])


def _table(title: str, rows: list[str]) -> str:
    return f"<h4>{title}</h4><table>{''.join(rows)}</table>" if rows else ""


def _row(name: str, text: str) -> str:
    return f"<tr><td>{name}</td><td>{text}</td></tr>"


def _parameter(parameter: Json) -> str:
    schema = parameter.get("schema", {})
    kinds = [part.get("type", "") for part in schema.get("anyOf", [schema])]
    facts = [parameter["in"], *(kind for kind in kinds if kind and kind != "null")]
    if parameter.get("required"):
        facts.append("required")
    if schema.get("default") is not None:
        facts.append(f"default {schema['default']}")
    text = parameter.get("description", schema.get("description", ""))
    return f'{escape(text)} <span class="soft">{escape(", ".join(facts))}</span>'


def _resolve(document: Json, schema: Json) -> Json:
    while "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rsplit("/", 1)[1]]
    return schema


def _content(document: Json, content: Json) -> str:
    """An example if the schema has one, else the names and descriptions of its fields."""
    schema = _resolve(document, content.get("schema", {}))
    for example in schema.get("examples", []):
        shown = json.dumps(example, indent=2, ensure_ascii=False)
        return f"<details><summary>example</summary><pre>{escape(shown)}</pre></details>"
    properties = schema.get("properties")
    if not properties:
        return f' <span class="soft">{escape(str(schema.get("format", schema.get("type", ""))))}</span>'
    rows = [
        _row(f"<code>{escape(name)}</code>", escape(_resolve(document, field).get("description", "")))
        for name, field in properties.items()
    ]
    return f"<details><summary>fields</summary><table>{''.join(rows)}</table></details>"


def _curl(method: str, path: str, operation: Json) -> str:
    """A command line that performs the operation."""
    address = path.replace("{map}", "lab").replace("{place}", "p7").replace("{sequence}", "monday")
    address = address.replace("{job}", "5f0c6a1de2b94c77")
    address = address.replace("{session}", "s-4f2a9c01d37be586")
    words = ["curl"] + ([] if method == "get" else ["-X", method.upper()])
    words.append(f"'http://127.0.0.1:8000{address}'")
    body = operation.get("requestBody", {}).get("content", {})
    if "image/jpeg" in body:
        words += ["-H 'Content-Type: image/jpeg'", "--data-binary @frame.jpg"]
    elif "application/json" in body:
        words += ["-H 'Content-Type: application/json'", "-d @body.json"]
    elif "multipart/form-data" not in body:
        words += [f"-H 'Content-Type: {kind}' --data-binary @file" for kind in list(body)[:1]]
    else:
        properties = body["multipart/form-data"]["schema"]["properties"]
        files = [name for name, field in properties.items() if field.get("format") == "binary"]
        words += ["-F places=@places.json"] if "places" in properties else []
        words += [f"-F {name}=@{name}.jpg" for name in files or ["frame7"]]
    return " ".join(words)


def _kinds() -> Iterator[str]:
    kinds = {kind.slug: kind for kind in [*KINDS.values(), *BY_STATUS.values()]}
    for kind in sorted(kinds.values(), key=lambda kind: (kind.status, kind.slug)):
        yield _row(f"<code>{kind.status}</code> <code>{escape(kind.type)}</code>", escape(kind.title))


def _problems() -> str:
    fields = "`type`, `title`, `status`, `detail`, `instance` and `request_id`"
    intro = f"Every error is `{MEDIA_TYPE}` (RFC 9457) with {fields}."
    return f'<h2 id="problems">Problems</h2>{_prose(intro)}<table>{"".join(_kinds())}</table>'
