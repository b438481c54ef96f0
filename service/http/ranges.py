"""Parts of an answer: conditional requests and one range of bytes (RFC 9110, sections 13 and 14)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from service.errors.faults import ExportGone, RangeNotSatisfiable

_ETAG = re.compile(r'(W/)?"([^"]*)"')
_RANGE = re.compile(r"bytes=\s*(?:(\d{1,18})-(\d{1,18})?|-(\d{1,18}))\s*", re.IGNORECASE)


@dataclass(frozen=True)
class Slice:
    """Bytes ``start`` to ``stop`` (not included) of ``size``."""

    start: int
    stop: int
    size: int

    @property
    def is_whole(self) -> bool:
        """Nothing is left out."""
        return (self.start, self.stop) == (0, self.size)

    @property
    def content_range(self) -> str:
        """Value of the header Content-Range."""
        return f"bytes {self.start}-{self.stop - 1}/{self.size}"


def strong_tags(header: str | None) -> list[str]:
    """The strong entity tags of a header, without their quotes."""
    return [tag for weak, tag in _ETAG.findall(header or "") if not weak]


def named_tags(headers: Mapping[str, str]) -> list[str]:
    """The tags of what the caller has a part of already, and wants the rest of."""
    return strong_tags(headers.get("if-match")) + strong_tags(headers.get("if-range"))


def check_match(headers: Mapping[str, str], tag: str) -> None:
    """See that the caller wants what there is.

    Raises:
        ExportGone: it insists on something else.
    """
    wanted = headers.get("if-match")
    if wanted is not None and wanted.strip() != "*" and tag not in strong_tags(wanted):
        raise ExportGone("What If-Match names is not kept any more: the map was changed since, so begin anew.")


def is_known(headers: Mapping[str, str], tag: str) -> bool:
    """Whether the caller has all of it already, as If-None-Match says."""
    held = headers.get("if-none-match")
    return held is not None and (held.strip() == "*" or tag in [found for _, found in _ETAG.findall(held)])


def wanted_slice(headers: Mapping[str, str], tag: str, size: int) -> Slice:
    """What of it the caller wants: all of it, unless it names one range that is of this very content.

    Raises:
        RangeNotSatisfiable: the range begins behind the end.
    """
    whole = Slice(0, size, size)
    named = _RANGE.fullmatch(headers.get("range", ""))
    condition = headers.get("if-range")
    if named is None or (condition is not None and tag not in strong_tags(condition)):
        return whole  # several ranges, other units and what cannot be read may be passed over
    first, last, suffix = named.groups()
    if suffix is not None:
        start, stop = max(0, size - int(suffix)), size
    else:
        start, stop = int(first), size if last is None else min(size, int(last) + 1)
        if last is not None and int(last) < start:
            return whole
    if start >= stop:
        raise RangeNotSatisfiable(f"The export has {size} bytes; the range begins behind them.", size)
    return Slice(start, stop, size)
