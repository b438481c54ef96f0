"""Numerals: how a number is written in a text, such as a query string or a table."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BeforeValidator

_NUMERAL = re.compile(r"-?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


def check_numeral(value: object) -> object:
    """Return a value if it is no text, or the text of a number in decimal digits of ASCII.

    Python reads more as numbers: ``1_000``, ``nan``, spaces around, digits of other scripts.

    Raises:
        ValueError: it is another text.
    """
    if isinstance(value, str) and not _NUMERAL.fullmatch(value):
        raise ValueError(f"{value[:40]!a} is not a number: write it with the digits 0 to 9, such as 5, -1.5 or 2e3")
    return value


Whole = Annotated[int, BeforeValidator(check_numeral)]
Decimal = Annotated[float, BeforeValidator(check_numeral)]
