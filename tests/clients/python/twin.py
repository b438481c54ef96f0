"""The synchronous half of the client, written from the asynchronous one.

    python -m tests.clients.python.twin     # writes it; so does scripts/client

``_async/concurrency.py`` and ``_sync/concurrency.py`` are written by hand: they hide what differs.
"""

from __future__ import annotations

import io
import re
import tokenize
from pathlib import Path

from tests.clients.python.models import PACKAGE, ROOT, formatted

BY_HAND = ("concurrency.py", "__init__.py")
NAMES = {
    "_async": "_sync",
    "enter_async_context": "enter_context",
    "aread": "read",
    "handle_async_request": "handle_request",
    "AsyncByteStream": "SyncByteStream",
    "aclose": "close",
    "aclosing": "closing",
    "aiter_bytes": "iter_bytes",
    "aiter_lines": "iter_lines",
    "asyncio": "sync",
    "asynccontextmanager": "contextmanager",
    "anext": "next",
    "StopAsyncIteration": "StopIteration",
    "__aenter__": "__enter__",
    "__aexit__": "__exit__",
    "__aiter__": "__iter__",
    "__anext__": "__next__",
}
DROPPED = ("async", "await")


def translated(source: str) -> str:
    """The source without ``async`` and ``await``, and with the names of the synchronous half."""
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    lines = source.splitlines(keepends=True)
    edits: list[tuple[int, int, int, str]] = []
    for token in tokens:
        (row, start), (last, end) = token.start, token.end
        if token.type == tokenize.NAME and token.string in DROPPED:
            edits.append((row, start, end + 1, ""))  # with the space behind it
        elif token.type == tokenize.NAME and (name := renamed(token.string)) != token.string:
            edits.append((row, start, end, name))
        elif token.type == tokenize.STRING and row == last:
            edits.append((row, start, end, spoken(token.string)))
        elif token.type == tokenize.STRING:
            for number, line in enumerate(lines[row - 1 : last], row):
                edits.append((number, 0, len(line), spoken(line)))
    for row, start, end, new in sorted(edits, reverse=True):
        line = lines[row - 1]
        lines[row - 1] = line[:start] + new + line[end:]
    return "".join(lines)


def renamed(name: str) -> str:
    if name in NAMES:
        return NAMES[name]
    return name.removeprefix("Async") if re.match(r"Async[A-Z]", name) else name


def spoken(line: str) -> str:
    """A docstring, and the code within it."""
    line = re.sub(r"\b(async|await) ", "", line)
    return re.sub(r"\b(Async[A-Z]\w*|_async|__a\w+__)", lambda found: renamed(found[0]), line)


def files() -> dict[Path, str]:
    """The modules and their text."""
    names = sorted(path.name for path in (PACKAGE / "_async").glob("*.py") if path.name not in BY_HAND)
    return {PACKAGE / "_sync" / name: rendered(name) for name in names}


def left_over() -> list[Path]:
    """Modules without a counterpart."""
    return [path for path in (PACKAGE / "_sync").glob("*.py") if not (PACKAGE / "_async" / path.name).exists()]


def rendered(name: str) -> str:
    """One module as it should be."""
    source = (PACKAGE / "_async" / name).read_text()
    remark = f"# Written from _async/{name} by scripts/client.  Do not edit.\n"
    return formatted(remark + translated(source), str((PACKAGE / "_sync" / name).relative_to(ROOT)))


def main() -> None:
    """Write the modules, and remove those that have no counterpart."""
    for path in left_over():
        path.unlink()
    for path, text in files().items():
        path.write_text(text)


if __name__ == "__main__":
    main()
