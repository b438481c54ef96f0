"""Where somebody should go again: stretches of a sequence of which several signs say that the map is weak there."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

Reason = Literal["never-matched", "distance-gap", "time-gap", "similarity-gap", "aliased", "hub"]

BRIDGED = 2
"""Stretches with so few frames between them are one."""

FEWEST_SILENT = 3
"""So many frames in a row that never matched are a sign; single ones are not."""

WEIGHTS: dict[Reason, float] = {
    "distance-gap": 3.0,
    "similarity-gap": 2.0,
    "time-gap": 1.0,
    "aliased": 1.0,
    "hub": 1.0,
    "never-matched": 0.5,
}
"""What a sign at one frame counts; a gap in distance is ground that was never shown."""


@dataclass(frozen=True)
class Sign:
    """Something that speaks against frames first … last of a sequence (positions in it)."""

    first: int
    last: int
    reason: Reason


@dataclass(frozen=True)
class Stretch:
    """Frames first … last of a sequence that should be taken again, and why.

    weight: how much speaks for it.
    """

    first: int
    last: int
    reasons: tuple[Reason, ...]
    weight: float


def silent_runs(matched: Iterable[bool]) -> list[Sign]:
    """Runs of frames that never matched, in a sequence of which other frames did."""
    flags = list(matched)
    signs, position = [], 0
    for was_matched, run in groupby(flags):
        length = len(list(run))
        if not was_matched and FEWEST_SILENT <= length < len(flags):
            signs.append(Sign(position, position + length - 1, "never-matched"))
        position += length
    return signs


def stretches(signs: Iterable[Sign]) -> list[Stretch]:
    """The signs of one sequence as stretches, those that touch or nearly touch as one; the weightiest first."""
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
