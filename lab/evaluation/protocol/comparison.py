"""The results of an evaluation, as the command line and the report show them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.frames.traverses import Truth
from lab.evaluation.data.published import PublishedRecall
from lab.evaluation.protocol.figures import Evaluation
from lab.evaluation.protocol.outcomes import Outcome

if TYPE_CHECKING:
    from lab.baselines.encoders import Box
    from lab.baselines.system import About


@dataclass(frozen=True)
class SystemRun:
    """One system on one pair of traverses.

    identity: of the system, ``<name>@<sha256>``.
    outcomes: one for each query, in their order.
    scores: float32 [Q, R'], higher is more alike; column j belongs to reference ``retained[j]`` of the comparison.
    bytes_per_place: mean over the retained references; None where the scores were computed elsewhere.
    milliseconds: medians per query, by stage; ``match`` is one query against all retained references.  None
        for a stage that the system lacks.
    cached: the figures, times included, are those of an earlier run.
    elsewhere: the scores were not computed here but read from a file.
    """

    about: About
    identity: str
    evaluation: Evaluation
    outcomes: list[Outcome]
    scores: NDArray[np.float32]
    bytes_per_place: int | None
    milliseconds: dict[str, float | None]
    cached: bool = False
    elsewhere: bool = False


@dataclass(frozen=True)
class ScalePoint:
    """One system on the first ``references`` places of the traverses (thesis, Fig. 3.9).

    milliseconds: median of matching one query against all these references.
    """

    system: str
    references: int
    queries: int
    auc_pr: float
    recall_at_1: float | None
    milliseconds: float


@dataclass(frozen=True)
class SizePoint:
    """The verdicts of one system in maps of ``places`` places, by the calibration that it ships.

    known, strangers: queries whose place was in the map, and queries whose place was not.
    known_recognized: share of the known that are recognized and right.
    strangers_recognized: share of the strangers that are recognized; None without any.
    calibration_error: of the probabilities, known and strangers counting alike; None without strangers.
    verified_known, verified_strangers, verified_error: the same after the candidates were verified geometrically; None
        also for a calibration that cannot weigh evidence.
    """

    system: str
    places: int
    known: int
    strangers: int
    known_recognized: float
    strangers_recognized: float | None
    calibration_error: float | None
    verified_known: float | None = None
    verified_strangers: float | None = None
    verified_error: float | None = None


@dataclass(frozen=True)
class SeverityCurve:
    """One system on query traverses that one disturbance changes more and more (thesis, 5.2 item 3).

    levels: rising, the first is the undisturbed traverse; in ``unit``.
    recall_at_1, auc_pr: one for each level.
    """

    disturbance: str
    system: str
    levels: list[float]
    unit: str
    recall_at_1: list[float]
    auc_pr: list[float]


@dataclass(frozen=True)
class SystemComparison:
    """Systems on one pair of traverses.

    name: of the data set.
    references, queries: the full traverses.
    retained: int64 [R'], ascending, indices of the references that were matched against.
    truth: of each query, indices into ``references``, retained or not.
    runs: best AUC-PR first.
    regions: gives the regions of interest of an image, by the best run whose system has some; None without one.
    regions_of: identity of that run; only its matches are shown with regions.
    notes: sentences about the data that a reader must know, such as how references were chosen.
    published: figures that others have published of this protocol; nothing of them was measured here.
    """

    name: str
    references: list[Path]
    queries: list[Path]
    retained: NDArray[np.int64]
    truth: Truth
    runs: list[SystemRun]
    regions: Callable[[Path], Sequence[Box] | None] | None = None
    regions_of: str | None = None
    scalability: list[ScalePoint] | None = None
    map_sizes: list[SizePoint] | None = None
    severity: list[SeverityCurve] | None = None
    notes: list[str] = field(default_factory=list)
    published: list[PublishedRecall] = field(default_factory=list)
