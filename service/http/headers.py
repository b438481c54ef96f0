"""Request headers of RFC 9110: the preferred form of an answer, entity tags and conditions."""

from __future__ import annotations

import re
from collections.abc import Mapping

from core.errors import RevisionMismatch
from service.errors.faults import ExportGone

_ETAG = re.compile(r'(W/)?"([^"]*)"')


# Content negotiation (section 12.5.1)


def preferred(accept: str | None, *offered: str) -> str:
    """The offered media type to which an Accept header gives the most weight.

    The first one is chosen among equals, and if the header accepts none of them.
    """
    if not accept:
        return offered[0]
    weights = [_weight(accept, media_type) for media_type in offered]
    return offered[max(range(len(offered)), key=lambda index: (weights[index], -index))]


def accepts(accept: str | None, media_type: str) -> bool:
    """Whether an Accept header allows a media type; one that is left out allows any."""
    return not accept or _weight(accept, media_type) > 0


def _weight(accept: str, media_type: str) -> float:
    """The weight of a media type: that of the most specific media range which includes it."""
    specificities = {media_type: 3, media_type.split("/")[0] + "/*": 2, "*/*": 1}
    best, weight = 0, 0.0
    for entry in accept.lower().split(","):
        name, *parameters = (part.strip() for part in entry.split(";"))
        specificity = specificities.get(name, 0)
        if specificity > best:
            best, weight = specificity, _quality(parameters)
    return weight


def _quality(parameters: list[str]) -> float:
    for parameter in parameters:
        if parameter.startswith("q="):
            try:
                return float(parameter[2:])
            except ValueError:
                return 0.0
    return 1.0


def accepts_gzip(accept_encoding: str | None) -> bool:
    """Whether an Accept-Encoding header allows gzip (section 12.5.3)."""
    weights: dict[str, float] = {}
    for entry in (accept_encoding or "").lower().split(","):
        name, *parameters = (part.strip() for part in entry.split(";"))
        weights[name] = _quality(parameters)
    return weights.get("gzip", weights.get("*", 0.0)) > 0


# Entity tags and conditional requests (section 13)


def entity_tag(revision: int) -> str:
    """The ETag of a map's revision."""
    return f'"{revision}"'


def expected_revision(if_match: str | None, current: int) -> int | None:
    """The revision that an edit requires; None if it accepts any.

    Args:
        if_match: the value of the If-Match header.
        current: the map's revision now.

    Raises:
        RevisionMismatch: the header names only other revisions.
    """
    if if_match is None or if_match.strip() == "*":
        return None
    if str(current) not in strong_tags(if_match):
        raise RevisionMismatch(
            f"The map has changed: it is at revision {current} and its ETag is {entity_tag(current)}. "
            "Read it again and repeat the edit."
        )
    return current


def strong_tags(header: str | None) -> list[str]:
    """The strong entity tags of a header, without their quotes."""
    return [tag for weak, tag in _ETAG.findall(header or "") if not weak]


def named_tags(headers: Mapping[str, str]) -> list[str]:
    """The entity tags of the content of which the caller has a part and wants the rest."""
    return strong_tags(headers.get("if-match")) + strong_tags(headers.get("if-range"))


def check_match(headers: Mapping[str, str], tag: str) -> None:
    """Check that If-Match, if the caller sends it, allows the content with this tag.

    Raises:
        ExportGone: the header names only other content.
    """
    wanted = headers.get("if-match")
    if wanted is not None and wanted.strip() != "*" and tag not in strong_tags(wanted):
        raise ExportGone("The export of If-Match is no longer stored. Download the map again from the beginning.")


def is_known(headers: Mapping[str, str], tag: str) -> bool:
    """Whether If-None-Match says that the caller has the content with this tag already."""
    held = headers.get("if-none-match")
    return held is not None and (held.strip() == "*" or tag in [found for _, found in _ETAG.findall(held)])
