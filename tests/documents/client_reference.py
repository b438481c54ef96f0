"""The page of the Python client, from its docstrings; ``tests.documents.reference`` writes it."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import placerec_client
from placerec_client import errors, parameters
from placerec_client._sync import client, jobs, keys, maps, places, review, sessions, streams

INTRODUCTION = """
# The Python client

This page is for those who write robots and tools in Python. It lists what `placerec_client` offers, as its docstrings
say it. [Use the Python client](../how-to/use-the-python-client.md) has examples.

`Client` blocks, and `AsyncClient` has the same names: its methods are awaited, its iterators are asynchronous, and its
contexts are entered with `async with`. This page shows the names of `Client`. Answers are the models of
[`openapi.json`](../../openapi.json), under the same names in `placerec_client.models`; fields that a later service adds
are ignored. Every call that takes `options` takes the parameters that are listed [below](#options).
"""

OBJECTS: tuple[tuple[str, type], ...] = (
    ("client", client.Client),
    ("client.maps", maps.Maps),
    ("lab", maps.Map),
    ("lab.places", places.Places),
    ("lab.sequences", maps.Sequences),
    ("lab.cameras", maps.Cameras),
    ("lab.review", review.Review),
    ("lab.sessions", sessions.Sessions),
    ("session", sessions.Session),
    ("stream", streams.Stream),
    ("client.jobs", jobs.Jobs),
    ("job", jobs.Job),
    ("client.encoders", client.Encoders),
    ("client.keys", keys.Keys),
)
"""What a caller has in hand, by the name that the examples give it."""

VALUES: tuple[Any, ...] = (
    *(placerec_client.Picture, placerec_client.NewPlace, placerec_client.Enrolled, placerec_client.Located),
    *(placerec_client.Odometry, placerec_client.MapEvent, placerec_client.Retry),
)

FRAMES = """
A frame is the bytes of a JPEG, PNG or WebP file, the path of one, one opened for reading, a NumPy array uint8 of shape
[H, W] or [H, W, 3] in OpenCV's order BGR, or a `Picture` of an array in the order RGB. Arrays are sent as PNG files,
which lose nothing.
"""

PROBLEMS = """
Each [kind of problem](http-operations.md#problems) that the service answers with is a class of
`placerec_client.problems`, named after it: `unknown-map` is `UnknownMap`. A kind that the client does not know is a
`Problem`. Only `deadline-exceeded` has another name, `DeadlineExceededByService`, and is a `DeadlineExceeded` as well.
"""


def page() -> str:
    """The page, without the remark that it is generated."""
    lines = [INTRODUCTION.strip(), ""]
    for name, kind in OBJECTS:
        lines += [f"## `{name}`", "", *described(kind), ""]
        for method in methods(kind):
            lines += [f"### `{name}.{signature(method)}`", "", *described(method), ""]
    lines += ["## Frames", "", FRAMES.strip(), "", "## Values", ""]
    for kind in VALUES:
        lines += [f"### `{kind.__name__}{fields(kind)}`", "", *described(kind), ""]
    lines += ["## Errors", "", PROBLEMS.strip(), ""]
    lines += ["| error | |", "|---|---|"]
    for error in kinds_of_errors():
        bases = ", ".join(base.__name__ for base in error.__bases__)
        lines.append(f"| `{error.__name__}` ({bases}) | {plain(first_paragraph(error)).replace('|', chr(92) + '|')} |")
    lines += ["", "## Options", ""]
    for name, found in options():
        lines += [f"### `{name}`", "", "| option | type | meaning |", "|---|---|---|", *found, ""]
    return "\n".join(lines)


def methods(kind: type) -> Iterator[Any]:
    """The public methods of a class in the order of its source."""
    for name, found in vars(kind).items():
        if inspect.isfunction(found) and not name.startswith("_"):
            yield found


def signature(method: Any) -> str:
    """Name and parameters as a caller writes them; options are named after their list."""
    shown = []
    for name, parameter in list(inspect.signature(method).parameters.items())[1:]:
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in shown:
            shown.append("*")
        if parameter.kind is parameter.VAR_KEYWORD:
            listed = re.search(r"parameters\.(\w+)", str(parameter.annotation))
            shown.append(f"**{listed[1] if listed else name}")
        else:
            shown.append(name if parameter.default is parameter.empty else f"{name}={parameter.default!r}")
    return f"{method.__name__}({', '.join(shown)})"


def fields(kind: type) -> str:
    shown = [name for name, one in inspect.signature(kind).parameters.items() if one.default is one.empty]
    return f"({', '.join([*shown, '…'][: len(inspect.signature(kind).parameters)])})"


def described(found: Any) -> list[str]:
    """A docstring as Markdown: paragraphs, code, and lists of arguments, results and errors."""
    text = inspect.cleandoc(found.__doc__ or "")
    lines: list[str] = []
    for block in re.split(r"\n\n(?=\S)", text):
        heading, _, rest = block.partition("\n")
        if heading in ("Args:", "Attributes:", "Raises:"):
            lines += [f"{heading[:-1].replace('Args', 'Arguments')}:", "", *items(rest), ""]
        elif heading == "Returns:":
            lines += [f"Returns: {plain(rest)}", ""]
        elif block.rstrip().endswith("::") or heading == "::":
            continue
        else:
            lines += [*textwrap.wrap(plain(block), 120), ""]
    for code in re.findall(r"::\n\n((?:    .*\n?|\n)+)", text):
        lines += ["```python", *textwrap.dedent(code).strip().splitlines(), "```", ""]
    return lines[:-1]


def items(block: str) -> list[str]:
    """The entries of a list of arguments, each with its text."""
    found: list[str] = []
    for line in textwrap.dedent(block).splitlines():
        name, colon, text = line.partition(":")
        if colon and not line.startswith(" "):
            found.append(f"* `{name}`:{plain(text) and ' ' + plain(text)}")
        elif found:
            found[-1] += " " + plain(line)
    return [part for one in found for part in textwrap.wrap(one, 120, subsequent_indent="  ", break_on_hyphens=False)]


def plain(text: str) -> str:
    """Text of a docstring as Markdown."""
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", text)
    return " ".join(text.replace("``", "`").split())


def first_paragraph(found: Any) -> str:
    return inspect.cleandoc(found.__doc__ or "").partition("\n\n")[0]


def kinds_of_errors() -> list[type]:
    return [one for one in vars(errors).values() if inspect.isclass(one) and issubclass(one, errors.PlacerecError)]


def options() -> Iterator[tuple[str, list[str]]]:
    """Each list of options with the rows of its table, from the source: texts after a field describe it."""
    tree = ast.parse(Path(inspect.getfile(parameters)).read_text())
    for kind in tree.body:
        if not isinstance(kind, ast.ClassDef):
            continue
        rows: list[tuple[str, str, str]] = []
        for part in kind.body:
            if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                rows.append((part.target.id, ast.unparse(part.annotation).replace("|", "\\|"), ""))
            elif rows and isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant):
                rows[-1] = (*rows[-1][:2], " ".join(str(part.value.value).split()).replace("|", "\\|"))
        yield kind.name, [f"| `{name}` | {type_} | {text} |" for name, type_, text in rows]
