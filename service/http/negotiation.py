"""Which of the forms on offer a caller likes best (RFC 9110, section 12.5.1)."""

from __future__ import annotations


def preferred(accept: str | None, *offered: str) -> str:
    """The offered media type that an Accept header weighs most; the first of equals, and if it wants none."""
    if not accept:
        return offered[0]
    weights = [_weight(accept, media_type) for media_type in offered]
    return offered[max(range(len(offered)), key=lambda index: (weights[index], -index))]


def _weight(accept: str, media_type: str) -> float:
    """The weight of a media type: that of the narrowest range which includes it."""
    ranges = {media_type: 3, media_type.split("/")[0] + "/*": 2, "*/*": 1}
    best, weight = 0, 0.0
    for entry in accept.lower().split(","):
        name, *parameters = (part.strip() for part in entry.split(";"))
        narrowness = ranges.get(name, 0)
        if narrowness > best:
            best, weight = narrowness, _quality(parameters)
    return weight


def _quality(parameters: list[str]) -> float:
    for parameter in parameters:
        if parameter.startswith("q="):
            try:
                return float(parameter[2:])
            except ValueError:
                return 0.0
    return 1.0
