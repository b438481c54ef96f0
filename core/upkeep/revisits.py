"""Where to take frames again: stretches of a sequence where several signs say that the map is weak."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

Reason = Literal["never-matched", "distance-gap", "time-gap", "similarity-gap", "aliased", "hub"]

BRIDGED = 2
"""Stretches with at most this many frames between them are joined."""

FEWEST_SILENT = 3
"""At least this many frames in a row that never matched are a sign."""

WEIGHTS: dict[Reason, float] = {
    "distance-gap": 3.0,
    "similarity-gap": 2.0,
    "time-gap": 1.0,
    "aliased": 1.0,
    "hub": 1.0,
    "never-matched": 0.5,
}
"""The weight of a sign; that of ``never-matched`` counts for each frame."""


@dataclass(frozen=True)
class Sign:
    """A reason to take the frames from ``first`` to ``last`` of a sequence again (positions in it)."""

    first: int
    last: int
    reason: Reason


@dataclass(frozen=True)
class Stretch:
    """Frames from ``first`` to ``last`` of a sequence that should be taken again.

    reasons: of the signs, each once.
    weight: the sum of the signs' weights.
    """

    first: int
    last: int
    reasons: tuple[Reason, ...]
    weight: float


def silent_runs(matched: Iterable[bool]) -> list[Sign]:
    """Find runs of frames that never matched, in a sequence with other frames that did."""
    flags = list(matched)
    signs, position = [], 0
    for was_matched, run in groupby(flags):
        length = len(list(run))
        if not was_matched and FEWEST_SILENT <= length < len(flags):
            signs.append(Sign(position, position + length - 1, "never-matched"))
        position += length
    return signs


def stretches(signs: Iterable[Sign]) -> list[Stretch]:
    """Join the signs of one sequence that touch or nearly touch into stretches, those of highest weight first."""
    found: list[Stretch] = []
    for sign in sorted(signs, key=lambda sign: (sign.first, sign.last)):
        weight = WEIGHTS[sign.reason] * (sign.last - sign.first + 1 if sign.reason == "never-matched" else 1)
        one = Stretch(sign.first, sign.last, (sign.reason,), weight)
        if found and sign.first <= found[-1].last + BRIDGED:
            before = found.pop()
            reasons = (*before.reasons, *(() if sign.reason in before.reasons else one.reasons))
            one = Stretch(before.first, max(before.last, one.last), reasons, before.weight + weight)
        found.append(one)
    return sorted(found, key=lambda stretch: -stretch.weight)
