"""Figures that others have published, as ``published.toml`` lists them; none of them was measured here.

Each was read in the source that stands beside it, or in a transcript of its table.  Unreadable ones are omitted,
which is all but one figure of MegaLoc, and so are those of another protocol than the one of that name here.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict

RECALLS = (1, 5, 10)


@dataclass(frozen=True)
class PublishedRecall:
    """The recall of one system under one protocol.

    recall_at: shares of the queries, in the order of ``RECALLS``; shorter where fewer are published.
    source: who published the figures, and where.
    """

    protocol: str
    system: str
    recall_at: tuple[float, ...]
    source: str
    year: int


class _Publication(BaseModel):
    """A publication with recalls in percent, by protocol and system."""

    model_config = ConfigDict(extra="forbid")
    source: str
    year: int
    recalls: dict[str, dict[str, tuple[float, ...]]]


def _published() -> tuple[PublishedRecall, ...]:
    tables = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))["sources"]
    return tuple(
        PublishedRecall(protocol, system, tuple(round(figure / 100, 4) for figure in percent), found.source, found.year)
        for found in map(_Publication.model_validate, tables)
        for protocol, systems in found.recalls.items()
        for system, percent in systems.items()
    )


PUBLISHED = _published()


def published_figures(protocol: str) -> list[PublishedRecall]:
    """The published results of a protocol, the best first; nothing for folders without a name."""
    found = [one for one in PUBLISHED if one.protocol == protocol]
    return sorted(found, key=lambda one: -one.recall_at[0])
