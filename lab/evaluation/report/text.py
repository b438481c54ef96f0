"""How names and numbers stand on the page: without control characters, rounded, with their unit."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

MISSING = "–"
"""Where there is no number."""


def plain(text: str) -> str:
    """Text that any font and any encoder of text takes: no control or direction characters, no lone surrogates.

    A file name need not be valid Unicode; other bytes are shown as ``\\udcff``.
    """
    whole = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return "".join(
        "\N{REPLACEMENT CHARACTER}" if unicodedata.category(letter)[0] == "C" else letter for letter in whole
    )


def number(value: float | None, digits: int = 3) -> str:
    """A number; a dash where there is none."""
    return MISSING if value is None else f"{value:.{digits}f}"


def milliseconds(value: float | None) -> str:
    """A time, in steps that can matter: ``0.006``, ``0.42``, ``3.1``, ``27``, ``1 280``."""
    if value is None:
        return MISSING
    digits = 3 if value < 0.095 else 2 if value < 0.995 else 1 if value < 9.95 else 0
    return f"{value:,.{digits}f}".replace(",", "\N{NO-BREAK SPACE}")


def size(count: int) -> str:
    """Bytes, by thousands: ``512 B``, ``197 KB``, ``1.2 MB``."""
    if count < 1_000:
        return f"{count}\N{NO-BREAK SPACE}B"
    if count < 999_500:
        return f"{count / 1e3:.{1 if count < 9_950 else 0}f}\N{NO-BREAK SPACE}KB"
    return f"{count / 1e6:.{1 if count < 99_950_000 else 0}f}\N{NO-BREAK SPACE}MB"


def counted(count: int, noun: str) -> str:
    """``1 query``, ``3 queries``."""
    if count == 1:
        return f"1 {noun}"
    return f"{count} {noun[:-1]}ies" if noun.endswith("y") else f"{count} {noun}s"


def enumerate_words(words: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def file_stems(names: Sequence[str]) -> list[str]:
    """File names without suffix for systems, each different, made of a-z, 0-9, dot and hyphen."""
    stems: list[str] = []
    for name in names:
        stem = re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-.")[:48] or "system"
        again = sum(other == stem or re.fullmatch(re.escape(stem) + r"-\d+", other) is not None for other in stems)
        while again and f"{stem}-{again + 1}" in stems:
            again += 1
        stems.append(f"{stem}-{again + 1}" if again else stem)
    return stems
