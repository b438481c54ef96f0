"""Numerals: how a number is written in a text, such as a query string or a table."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BeforeValidator

_NUMERAL = re.compile(r"-?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
_SPACED_EXPONENT = re.compile(r"[0-9.][eE] [0-9]")

LOST_PLUS = "a + in a query string is written %2B"
"""The likely cause of a space where a plus belongs."""


def check_numeral(value: object) -> object:
    """Return a value if it is no text, or the text of a number in decimal digits of ASCII.

    Python reads more as numbers: ``1_000``, ``nan``, spaces around, digits of other scripts.

    Raises:
        ValueError: it is another text.
    """
    return _checked(value, "5, -1.5 or 2e3")


def _checked(value: object, examples: str) -> object:
    if isinstance(value, str) and not _NUMERAL.fullmatch(value):
        hint = f" ({LOST_PLUS})" if _SPACED_EXPONENT.search(value) else ""
        raise ValueError(f"{value[:40]!a} is not a number: write it with the digits 0 to 9, such as {examples}{hint}")
    return value


def check_whole_numeral(value: object) -> object:
    """As :func:`check_numeral`, of a whole number."""
    return _checked(value, "5 or -1")


Whole = Annotated[int, BeforeValidator(check_whole_numeral)]
Decimal = Annotated[float, BeforeValidator(check_numeral)]
