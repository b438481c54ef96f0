"""Drives a robot through a situation, and compares its answers with the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import hypot
from typing import Literal, TypeAlias

import numpy as np

from benchmarks.day.maps import shown_by
from benchmarks.day.robots import Mode, RobotAnswer, on_its_way
from benchmarks.day.situations import Moment
from core.maps import MapSettings
from placerec_client import ConnectionFailed

Outcome: TypeAlias = Literal["right", "wrong", "ambiguous", "unknown", "nowhere", "silent"]
"""Of a frame: recognized at its place or at another one; ambiguous; unknown although the map has its place, or because
it has not; or without an answer."""

LETTERS: dict[Outcome, str] = {
    "right": "R",
    "wrong": "W",
    "ambiguous": "a",
    "unknown": "u",
    "nowhere": "n",
    "silent": "-",
}

NEAR = MapSettings().same_place_radius
"""Metres within which a place that a robot enrolled shows what it sees."""


@dataclass(frozen=True)
class DriveOutcomes:
    """The outcome of each frame.

    again: seconds from the first frame after a disturbance until one is recognized and right, the longest of them;
        infinite if none is; None without a disturbance.
    """

    outcomes: tuple[Outcome, ...]
    again: float | None

    def count(self, outcome: Outcome) -> int:
        """How many frames came out so."""
        return self.outcomes.count(outcome)

    @property
    def trail(self) -> str:
        """A letter for each frame."""
        return "".join(LETTERS[one] for one in self.outcomes)


def drive(url: str, map_id: str, mode: Mode, way: Iterable[Moment], restart: Callable[[], None]) -> DriveOutcomes:
    """Let a robot go its way.

    Args:
        url: of the service.
        restart: ends the service and starts it again, at the same URL with the same data.
    """
    outcomes: list[Outcome] = []
    waited: list[float] = []
    since: float | None = None
    enrolled: dict[str, Moment] = {}
    with on_its_way(url, map_id, mode) as (robot, radio):
        for moment in way:
            if moment.restart:
                restart()
            if moment.again:
                waited += [np.inf] if since is not None else []
                since = moment.second
            radio.fate = moment.fate
            try:
                answer = robot.ask(moment)
            except ConnectionFailed:
                if moment.fate == "answered":
                    raise
                outcomes.append("silent")
                continue
            found = _outcome(answer, moment, enrolled)
            outcomes.append(found)
            if answer.enrolled is not None:
                enrolled[answer.enrolled] = moment
            if found == "right" and since is not None:
                waited.append(moment.second - since)
                since = None
    waited += [np.inf] if since is not None else []
    return DriveOutcomes(tuple(outcomes), max(waited, default=None))


def _outcome(answer: RobotAnswer, moment: Moment, enrolled: dict[str, Moment]) -> Outcome:
    if answer.verdict == "ambiguous":
        return "ambiguous"
    if answer.place is None:
        here = moment.right or any(_same(moment, one) for one in enrolled.values())
        return "unknown" if here else "nowhere"
    own = enrolled.get(answer.place)
    is_right = _same(moment, own) if own is not None else shown_by(answer.place) in moment.right
    return "right" if is_right else "wrong"


def _same(one: Moment, other: Moment) -> bool:
    return hypot(one.pose.x - other.pose.x, one.pose.y - other.pose.y) <= NEAR
