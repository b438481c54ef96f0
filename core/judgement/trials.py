"""Trials: queries whose truth is known, judged, to tell when an answer can be believed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from core.judgement.verdict import Calibration, Judgement, probability_of

Flags = NDArray[np.bool_]
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Trials:
    """Outcomes of n queries, float64 [n], bool [n] and int64 [n].

    decision: the decision value.
    margin: lead over the best rival; infinite without one.
    known: the place was in the map.
    right: it was the best match.
    frame: number of the frame that was asked.  One asked twice, of a map with its place and of one without, has one
        number; numbers follow the order in which the frames were taken.
    """

    decision: Values
    margin: Values
    known: Flags
    right: Flags
    frame: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.decision)

    def take(self, chosen: Flags) -> Trials:
        """Some of them."""
        return Trials(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def recognized(self, calibration: Calibration) -> Flags:
        """Which of them a calibration lets pass, bool [n]."""
        return (self.decision >= calibration.threshold) & (self.margin >= calibration.margin)

    def probabilities(self, calibration: Calibration) -> Values:
        """That each is right, by a calibration with a curve, float64 [n]."""
        pairs = zip(self.decision.tolist(), self.margin.tolist(), strict=True)
        return np.array([probability_of(decision, margin, calibration) for decision, margin in pairs], np.float64)


@dataclass(frozen=True)
class Trial:
    """One query: the judgement of it, whether its place was there, whether it was found."""

    judgement: Judgement
    known: bool
    right: bool
    frame: int


def gathered(trials: Iterable[Trial]) -> Trials:
    """Single trials as one; those of an empty map, which has no decision value, are left out."""
    rows = [
        (
            one.judgement.decision,
            np.inf if one.judgement.margin is None else one.judgement.margin,
            one.known,
            one.right,
            one.frame,
        )
        for one in trials
        if one.judgement.decision is not None
    ]
    decision, margin, known, right, frame = zip(*rows, strict=True) if rows else ((),) * 5
    return Trials(
        np.array(decision, np.float64),
        np.array(margin, np.float64),
        np.array(known, np.bool_),
        np.array(right, np.bool_),
        np.array(frame, np.int64),
    )


def joined(parts: Sequence[Trials], same_frames: bool = False) -> Trials:
    """Several sets of trials as one; their frames are numbered on, unless they are the same in all of them."""
    shifted, first = [], 0
    for part in parts:
        shifted.append(part.frame + first)
        if len(part) and not same_frames:
            first += int(part.frame.max()) + 1
    names = ("decision", "margin", "known", "right")
    decision, margin, known, right = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return Trials(decision, margin, known, right, np.concatenate(shifted))
