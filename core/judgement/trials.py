"""Trials: judged queries whose true place is known, from which calibrations are fitted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from core.judgement.verdict import Calibration, Judgement, probability_of

_NUMBERS = ("decision", "margin", "known", "right", "imagined")

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
    """

    decision: Values
    margin: Values
    known: Flags
    right: Flags
    frame: NDArray[np.int64]
    imagined: Values = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if len(self.imagined) < len(self.decision):
            object.__setattr__(self, "imagined", np.zeros(len(self.decision)))

    def __len__(self) -> int:
        return len(self.decision)

    def take(self, chosen: Flags) -> Trials:
        """The trials that are chosen, bool [n]."""
        return Trials(*(getattr(self, column.name)[chosen] for column in fields(self)))

    def recognized(self, calibration: Calibration) -> Flags:
        """Which of them are recognized by a calibration, bool [n]."""
        return (self.decision >= calibration.threshold) & (self.margin >= calibration.margin)

    def probabilities(self, calibration: Calibration) -> Values:
        """The probability that each is right, by a calibration with a curve, float64 [n]."""
        rows = zip(self.decision.tolist(), self.margin.tolist(), self.imagined.tolist(), strict=True)
        return np.array([probability_of(d, margin, calibration, share) for d, margin, share in rows], np.float64)


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
            np.inf if one.judgement.margin is None else one.judgement.margin,
            one.known,
            one.right,
            one.frame,
            one.judgement.imagined,
        )
        for one in trials
        if one.judgement.decision is not None
    ]
    decision, margin, known, right, frame, imagined = zip(*rows, strict=True) if rows else ((),) * 6
    return Trials(
        np.array(decision, np.float64),
        np.array(margin, np.float64),
        np.array(known, np.bool_),
        np.array(right, np.bool_),
        np.array(frame, np.int64),
        np.array(imagined, np.float64),
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
