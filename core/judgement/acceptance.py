"""Whether a calibration may be stored: what it would change for answers that had no part in it.

Answers are of two kinds: to frames whose place is in the map, and to strangers.  Both count alike, however many of each
there are, for how many of a robot's frames are strangers is not known.  The error of an answer is the square of its
probability minus 1 if the best match was right, else minus 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from core.judgement.calibration import FEWEST_OUTCOMES, FittedCalibration
from core.judgement.reliability import brier
from core.judgement.trials import StagedTrials
from core.judgement.verdict import Calibration

Values = NDArray[np.float64]

WORSE = 0.01
"""From this rise of the mean error of both kinds a calibration is worse than the one before."""

WORSE_FOR_STRANGERS = 0.2
"""The same of strangers alone, whatever it does for places of the map.  It was at most 0.16 in the calibrations by runs
of ``benchmarks.learning.calibration`` (in fog), and from 0.2 to 0.9 where labels had shown no stranger."""

SURE = 2.0
"""A rise counts that is more than this many of its standard errors, and of ``FEWEST_OUTCOMES`` answers or more: that of
a few may be chance."""


class Stated(BaseModel):
    """The probabilities that a calibration states for some answers."""

    probability: float = Field(description="Their mean.")
    error: float = Field(description="Mean square of probability minus outcome (the Brier score).")


class KindChange(BaseModel):
    """The probabilities of one kind of answers, before and after."""

    answers: int
    before: Stated
    after: Stated


class HeldOutChange(BaseModel):
    """What a calibration changes for answers that had no part in it."""

    known: KindChange | None = Field(description="Of frames whose place is in the map; null without any.")
    strangers: KindChange | None = Field(
        description="Of frames whose place the map lacks, or that were asked in the map without their place. Null "
        "without any."
    )
    worse: str | None = Field(description="Why the calibration is not stored; null: it may be.")


def held_out_change(
    found: FittedCalibration, before: Calibration, drawn: StagedTrials | None = None
) -> HeldOutChange | None:
    """Compare a calibration with another one on answers that had no part in it.

    Args:
        before: the calibration in force.
        drawn: answers to strangers, none of which the calibration was fitted to; None: there are none.

    Returns:
        None if the calibration in force has no curve, so that there is nothing to compare with.
    """
    if before.curve is None:
        return None
    asked = found.staged.answered(before)
    stated = [(asked.known, asked.probabilities(before), asked.right, found.held_out.probability, found.held_out.right)]
    if drawn is not None and len(drawn):
        one, other = drawn.answered(before), drawn.answered(found.calibration)
        then = other.probabilities(found.calibration)
        stated.append((one.known, one.probabilities(before), one.right, then, other.right))
    known, was, was_right, then, then_right = (np.concatenate(columns) for columns in zip(*stated, strict=True))
    rises = np.square(then - then_right) - np.square(was - was_right)
    kinds: list[KindChange | None] = []
    for chosen in (known, ~known):
        if not chosen.any():
            kinds.append(None)
            continue
        one_kind = ((was[chosen], was_right[chosen]), (then[chosen], then_right[chosen]))
        told = [Stated(probability=float(p.mean()), error=brier(p, right)) for p, right in one_kind]
        kinds.append(KindChange(answers=int(chosen.sum()), before=told[0], after=told[1]))
    return HeldOutChange(known=kinds[0], strangers=kinds[1], worse=_worse(rises[known], rises[~known], kinds))


def _worse(known: Values, strangers: Values, kinds: list[KindChange | None]) -> str | None:
    """Why a calibration is worse than the one before, by the rises of the errors of either kind, float64 [n] each."""
    some = [one for one in (known, strangers) if len(one)]
    if len(strangers) and _rises(strangers, least=WORSE_FOR_STRANGERS):
        what = "strangers would be believed"
    elif some and _rises(*some, least=WORSE):
        what = "answers that had no part in it would become worse"
    else:
        return None
    figures = [
        f"of {one.answers} {name} the mean probability goes from {one.before.probability:.3f} to "
        f"{one.after.probability:.3f}, the error from {one.before.error:.3f} to {one.after.error:.3f}"
        for name, one in zip(("answers to known places", "answers to strangers"), kinds, strict=True)
        if one is not None
    ]
    return f"By this calibration {what}: {'; '.join(figures)}."


def _rises(*kinds: Values, least: float) -> bool:
    """Whether the mean over some kinds of the mean rise of each, float64 [n], is more than ``least``, and no chance."""
    mean = float(np.mean([one.mean() for one in kinds]))
    variances = [one.var(ddof=1) / len(one) if len(one) >= FEWEST_OUTCOMES else np.inf for one in kinds]
    return mean > least and mean > SURE * float(np.sqrt(sum(variances))) / len(kinds)
