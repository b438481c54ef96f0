"""Which runs are independent witnesses: those of two robots, or of one robot half a day apart.

A robot that passes twice within an hour sees the same light and the same parked cars, and makes the same mistakes,
whether midnight lies between its runs or not.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

APART = timedelta(hours=12)
"""Between the beginnings of two runs of one robot that are two witnesses."""


@dataclass(frozen=True)
class Witness:
    """The robot of a run, and when the run began; as a text, which is stored, the robot, a space and the moment.

    robot: a name for it.
    began: with a time zone.
    """

    robot: str
    began: datetime

    def __str__(self) -> str:
        return f"{self.robot} {self.began.astimezone(UTC).isoformat(timespec='seconds')}"

    @classmethod
    def of(cls, text: str) -> Witness:
        """The witness of a stored text, in which a day alone is its first moment.

        Raises:
            ValueError: the text is another.
        """
        robot, _, moment = text.rpartition(" ")
        began = datetime.fromisoformat(moment)
        return cls(robot, began if began.tzinfo else began.replace(tzinfo=UTC))

    def independent_of(self, other: Witness) -> bool:
        """Whether two runs are two witnesses."""
        return self.robot != other.robot or abs(self.began - other.began) >= APART


def count_witnesses(runs: Iterable[Witness]) -> int:
    """How many of some runs are witnesses that are all independent of one another, at most."""
    found: list[Witness] = []
    for one in sorted(runs, key=lambda run: run.began):
        if all(one.independent_of(other) for other in found):
            found.append(one)
    return len(found)
