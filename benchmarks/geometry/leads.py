"""How much the lead over rivals may say of a verified answer: three numbers, tried on tasks to fit on.

The probability is σ(log odds + gained · (1 - u)) · (ℓ + (1 - ℓ) · min(1, m / M)), with the lead m over the best rival,
the share u of other places that were imagined, and log odds of three stages (``core.judgement.geometry``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from core.judgement.geometry import LEAD, TERMS, WITHOUT_A_LEAD
from core.judgement.probability import sigmoid
from core.judgement.reliability import reliability
from core.judgement.verdict import Calibration, Judgement, log_odds_of

Array = NDArray[np.float64]
Numbers = tuple[float, float, float]
"""The log odds that a lead gains, what is left without one, ℓ, and the lead M that is enough."""

SHIPPED: Numbers = (TERMS.lead, WITHOUT_A_LEAD, LEAD)
GRID = ((0.0, 1.0, 2.0, 3.0, 4.0), (0.05, 0.1, 0.2, 0.5), (0.003, 0.03, 0.05, 0.08))


@dataclass(frozen=True)
class VerifiedAnswers:
    """The n answers of a task that were verified, float64 [n] and bool [n].

    odds: log odds of three stages, rivals left out of account.
    imagined: the share of other places that were imagined.
    margin: the lead over the best rival; infinite without one.
    right: whether the best match is.
    """

    odds: Array
    imagined: Array
    margin: Array
    right: NDArray[np.bool_]

    @classmethod
    def of(cls, judged: Sequence[tuple[Judgement, bool]], calibration: Calibration) -> VerifiedAnswers:
        """Of judgements, and whether their best matches are right."""
        rows = [
            (
                float(np.asarray(log_odds_of(one.decision, calibration, one.imagined, one.evidence))),
                one.imagined,
                np.inf if one.margin is None else one.margin,
                right,
            )
            for one, right in judged
            if one.evidence is not None and one.decision is not None
        ]
        odds, imagined, margin, rights = np.array(rows, np.float64).reshape(-1, 4).T
        return cls(odds, imagined, margin, rights > 0)

    def probabilities(self, numbers: Numbers) -> Array:
        """By other numbers than those that are shipped."""
        gained, left, enough = numbers
        shares = left + (1 - left) * np.minimum(1.0, self.margin / enough)
        return np.asarray(sigmoid(self.odds + gained * (1 - self.imagined)) * shares, np.float64)

    def loss(self, numbers: Numbers) -> float:
        """The mean of -ln of the probability of what was the case."""
        stated = np.clip(self.probabilities(numbers), 1e-6, 1 - 1e-6)
        return float(-np.log(np.where(self.right, stated, 1 - stated)).mean())

    def error(self, numbers: Numbers) -> float:
        """The calibration error."""
        return reliability(self.probabilities(numbers), self.right).ece

    def false(self, numbers: Numbers) -> float:
        """The share of the wrong that is stated to be rather right."""
        return float((self.probabilities(numbers)[~self.right] >= 0.5).mean()) if (~self.right).any() else 0.0


def lead_figures(by_kind: dict[str, list[VerifiedAnswers]]) -> list[tuple[Numbers, float, float, float]]:
    """All numbers of the grid, those of least loss first, with loss, calibration error and wrong ones believed.

    Args:
        by_kind: the tasks to fit on; each kind counts alike, and in a kind each task.
    """

    def mean(values: dict[str, list[float]]) -> float:
        return float(np.mean([np.mean(some) for some in values.values()]))

    rows = []
    for numbers in sorted({*product(*GRID), SHIPPED}):
        losses, errors, false = (
            mean({kind: [getattr(one, figure)(numbers) for one in some] for kind, some in by_kind.items()})
            for figure in ("loss", "error", "false")
        )
        rows.append((numbers, losses, errors, false))
    return sorted(rows, key=lambda row: row[1])
