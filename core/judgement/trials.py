"""Trials: judged queries whose true place is known, from which calibrations are fitted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.judgement.verdict import (
    DOUBT,
    MOSTLY_IMAGINED,
    Calibration,
    Judgement,
    most_doubtful,
    probability_of,
    stands_out,
)

_STORED: Mapping[str, tuple[Any, float]] = {
    "decision": (np.float64, 0.0),
    "margin": (np.float64, np.inf),
    "known": (np.bool_, False),
    "right": (np.bool_, False),
    "frame": (np.int64, 0),
    "imagined": (np.float64, 0.0),
    "evidence": (np.float64, np.nan),
}
"""The type of each column, and the value that null stands for."""

_NUMBERS = ("decision", "margin", "known", "right", "imagined", "evidence")

Flags = NDArray[np.bool_]
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Trials:
    """The outcomes of n queries.

    decision: float64 [n], the decision value.
    margin: float64 [n], the lead over the best rival; infinite without one.
    known: bool [n], whether the place was in the map.
    right: bool [n], whether it was the best match.
    frame: int64 [n], the number of the query's frame, in the order in which the frames were taken.  A frame that is a
        query of a map with its place and of a map without it has the same number in both.
    imagined: float64 [n], the share of the background that was imagined; zeros if left out.
    evidence: float64 [n], of the best match; NaN where it was not verified, and everywhere if left out.
    """

    decision: Values
    margin: Values
    known: Flags
    right: Flags
    frame: NDArray[np.int64]
    imagined: Values = field(default_factory=lambda: np.empty(0))
    evidence: Values = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        for name, value in (("imagined", 0.0), ("evidence", np.nan)):
            if len(getattr(self, name)) < len(self.decision):
                object.__setattr__(self, name, np.full(len(self.decision), value))

    def __len__(self) -> int:
        return len(self.decision)

    def take(self, chosen: Flags) -> Trials:
        """The trials that are chosen, bool [n]."""
        return Trials(*(getattr(self, column.name)[chosen] for column in fields(self)))

    def standing_out(self, calibration: Calibration) -> Flags:
        """Which of them are believed by a calibration if their lead is large enough, bool [n]."""
        return stands_out(self.decision, self.margin, calibration, self.imagined, self.evidence)

    def recognized(self, calibration: Calibration) -> Flags:
        """Which of them are recognized by a calibration, bool [n]."""
        return self.standing_out(calibration) & (self.margin >= calibration.margin)

    def probabilities(self, calibration: Calibration) -> Values:
        """The probability that each is right, by a calibration with a curve, float64 [n]."""
        stated = probability_of(self.decision, self.margin, calibration, self.imagined, self.evidence)
        if stated is None:
            raise ValueError("a calibration without a curve states no probabilities")
        return stated

    def record(self) -> dict[str, list[float | None]]:
        """The trials as lists for JSON, by the names of the fields; null stands for infinite and missing values."""
        return {
            column.name: [value if np.isfinite(value) else None for value in getattr(self, column.name).tolist()]
            for column in fields(self)
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Sequence[float | None]]) -> Trials:
        """The trials of lists that :meth:`record` made.

        Raises:
            KeyError, TypeError, ValueError: the lists are others.
        """
        found = {}
        for name, (dtype, missing) in _STORED.items():
            values = [missing if value is None else value for value in record[name]]
            found[name] = np.array(values, dtype)
        if len({len(values) for values in found.values()}) > 1:
            raise ValueError("the lists are of different lengths")
        return cls(**found)


@dataclass(frozen=True)
class StagedTrials:
    """The outcomes of the same queries, in the same order, by two stages and by three.

    three: with every query verified of which keypoints are known; of the others as by two stages.
    """

    two: Trials
    three: Trials

    @classmethod
    def of(cls, trials: Trials | StagedTrials) -> StagedTrials:
        """Trials whose answers stay what they are, whatever the calibration: by two stages, or as robots had them."""
        return trials if isinstance(trials, StagedTrials) else cls(trials, trials)

    def __len__(self) -> int:
        return len(self.two)

    def take(self, chosen: Flags) -> StagedTrials:
        """The trials that are chosen, bool [n]."""
        return StagedTrials(self.two.take(chosen), self.three.take(chosen))

    def record(self) -> dict[str, dict[str, list[float | None]]]:
        """The trials of either kind as lists for JSON (:meth:`Trials.record`)."""
        return {"two": self.two.record(), "three": self.three.record()}

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> StagedTrials:
        """The trials of what :meth:`record` made, or of the lists of trials whose answers stay what they are.

        Raises:
            KeyError, TypeError, ValueError: it is something else.
        """
        if "two" not in record:
            return cls.of(Trials.of_record(record))
        found = cls(Trials.of_record(record["two"]), Trials.of_record(record["three"]))
        if len(found.two) != len(found.three):
            raise ValueError("the lists are of different lengths")
        return found

    def answered(self, calibration: Calibration) -> Trials:
        """The outcomes with ``verify=auto``: by three stages where two leave doubt, by a calibration with a curve."""
        two = self.two
        if calibration.geometry is None or calibration.curve is None:
            return two
        stated, believed = two.probabilities(calibration), two.standing_out(calibration)
        doubtful = (stated > DOUBT[0]) & (stated < most_doubtful(calibration))
        doubtful |= (believed & (two.margin < calibration.margin)) | (two.imagined > MOSTLY_IMAGINED)
        columns = {one.name: (getattr(two, one.name), getattr(self.three, one.name)) for one in fields(two)}
        return Trials(**{name: np.where(doubtful, three, of_two) for name, (of_two, three) in columns.items()})


@dataclass(frozen=True)
class Trial:
    """One query: its judgement, whether its place was in the map, whether that was the best match, and its frame."""

    judgement: Judgement
    known: bool
    right: bool
    frame: int


def gathered(trials: Iterable[Trial]) -> Trials:
    """Gather single trials; those on an empty map, which have no decision value, are left out."""
    rows = [
        (
            one.judgement.decision,
            one.judgement.lead,
            one.known,
            one.right,
            one.frame,
            one.judgement.imagined,
            np.nan if one.judgement.evidence is None else one.judgement.evidence,
        )
        for one in trials
        if one.judgement.decision is not None
    ]
    decision, margin, known, right, frame, imagined, found = zip(*rows, strict=True) if rows else ((),) * 7
    return Trials(
        np.array(decision, np.float64),
        np.array(margin, np.float64),
        np.array(known, np.bool_),
        np.array(right, np.bool_),
        np.array(frame, np.int64),
        np.array(imagined, np.float64),
        np.array(found, np.float64),
    )


def joined(parts: Sequence[Trials], same_frames: bool = False) -> Trials:
    """Join several sets of trials; their frames are numbered consecutively unless all sets have the same frames."""
    shifted, first = [], 0
    for part in parts:
        shifted.append(part.frame + first)
        if len(part) and not same_frames:
            first += int(part.frame.max()) + 1
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _NUMBERS}
    return Trials(frame=np.concatenate(shifted), **columns)


def joined_stages(parts: Sequence[StagedTrials]) -> StagedTrials:
    """Join several sets of trials; their frames are numbered consecutively."""
    return StagedTrials(joined([one.two for one in parts]), joined([one.three for one in parts]))
