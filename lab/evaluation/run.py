"""Several systems on one pair of traverses: the whole evaluation, from top to bottom.

For each system: describe the references, describe the queries, score every query against all references, judge the
best matches by the truth, compute the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lab.baselines.encoders import EncoderSystem
from lab.baselines.system import System
from lab.evaluation.cache import CacheEntry, EvaluationCache
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.data.published import published_figures
from lab.evaluation.map_sizes import map_sizes
from lab.evaluation.protocol.comparison import ScalePoint, SeverityCurve, SizePoint, SystemComparison, SystemRun
from lab.evaluation.protocol.figures import STAGES, summarize
from lab.evaluation.protocol.outcomes import judge, matched_scores
from lab.evaluation.protocol.trust import trust_figures
from lab.evaluation.scalability import scalability, scale_steps
from lab.evaluation.severity import severity, severity_steps
from lab.evaluation.subject import Described, Load, Subject, Training


class ProgressWatch(Protocol):
    """Receives the progress of the evaluation."""

    def begin(self, system: str, steps: int) -> None:
        """A system comes next; it takes ``steps`` steps, or fewer where something was in the cache."""

    def advance(self) -> None:
        """An image was learned from or described, or a query was scored."""

    def end(self) -> None:
        """The system is done."""


@dataclass(frozen=True)
class Extras:
    """The measurements besides the figures, and the seed of disturbances and of maps."""

    scalability: bool = False
    severity: bool = False
    seed: int = 0
    map_sizes: bool = False


def compare_systems(
    systems: Sequence[System],
    pair: TraversePair,
    training: Training,
    load: Load,
    cache: EvaluationCache,
    watch: ProgressWatch,
    extras: Extras = Extras(),
    others: Sequence[SystemRun] = (),
) -> SystemComparison:
    """Evaluate each system in turn; each result is cached as soon as it exists.

    Args:
        load: decodes an image; its exceptions end the run.
        others: runs whose scores were computed elsewhere.

    Raises:
        InvalidModel: a system gives no finite scores, or cannot learn from the images of ``training``.
    """
    runs: list[SystemRun] = []
    points: list[ScalePoint] = []
    sizes: list[SizePoint] = []
    curves: list[SeverityCurve] = []
    for system in systems:
        subject = Subject(system, pair, training, load, watch.advance)
        watch.begin(subject.about.name, _steps(subject, extras))
        runs.append(evaluate(subject, cache))
        if extras.scalability:
            points += scalability(subject, cache)
        if extras.map_sizes:
            sizes += map_sizes(subject, cache, seed=extras.seed)
        if extras.severity:
            curves += severity(subject, cache, seed=extras.seed)
        watch.end()
    ranked = best_first([*runs, *others])
    seeing = _best_encoder(systems, ranked)
    return SystemComparison(
        name=pair.name,
        references=pair.references,
        queries=pair.queries,
        retained=pair.retained,
        truth=pair.truth,
        runs=ranked,
        regions=None if seeing is None else lambda path: seeing.region_boxes(load(path)),
        regions_of=None if seeing is None else seeing.identity,
        scalability=points if extras.scalability else None,
        map_sizes=sizes if extras.map_sizes else None,
        severity=curves if extras.severity else None,
        notes=list(pair.notes),
        published=published_figures(pair.protocol),
    )


def evaluate(subject: Subject, cache: EvaluationCache) -> SystemRun:
    """The figures of one system; measured now, or taken from the cache with the times of then."""
    key = subject.key("run")
    measured = _loaded(cache.load(key), subject)
    cached = measured is not None
    if measured is None:
        measured = measure(subject)
        cache.store(key, _entry(measured))
    outcomes = judge(measured.scores, subject.pair.retained, subject.pair.truth, subject.pair.excluded)
    evaluation = summarize(
        measured.identity,
        outcomes,
        len(subject.pair.retained),
        measured.milliseconds,
        describe_milliseconds=measured.describe_milliseconds,
        bytes_per_place=measured.bytes_per_place,
        trained_on=subject.trained_on,
    )
    matched = matched_scores(measured.scores, subject.pair.retained, subject.pair.excluded)
    trusted = trust_figures(matched, subject.pair.retained, outcomes, evaluation.notes)
    evaluation = evaluation.model_copy(update=trusted)
    return SystemRun(
        about=subject.about,
        identity=measured.identity,
        evaluation=evaluation,
        outcomes=outcomes,
        scores=measured.scores,
        bytes_per_place=measured.bytes_per_place,
        milliseconds=evaluation.milliseconds,
        cached=cached,
    )


@dataclass(frozen=True)
class SystemMeasurement:
    """The measurements before any judgement.

    identity: of the system, after training.
    scores: float32 [Q, R'].
    bytes_per_place: mean over the references.
    milliseconds: medians per query by stage.
    describe_milliseconds: median per query, all stages before matching.
    """

    identity: str
    scores: NDArray[np.float32]
    bytes_per_place: int
    milliseconds: dict[str, float | None]
    describe_milliseconds: float


def measure(subject: Subject) -> SystemMeasurement:
    """Describe the retained references, describe the queries, score each query against all references.

    Raises:
        InvalidModel: the system gives no finite scores, or cannot learn from the training images.
    """
    references = subject.references
    queries = subject.queries
    index = subject.system.index(references.descriptions)
    scored = subject.score(index, queries.descriptions)
    sizes = [description.nbytes for description in references.descriptions]
    return SystemMeasurement(
        identity=subject.system.identity,
        scores=scored.scores,
        bytes_per_place=round(sum(sizes) / len(sizes)),
        milliseconds={**stage_medians(queries), "match": float(np.median(scored.milliseconds))},
        describe_milliseconds=float(np.median(queries.milliseconds)),
    )


def stage_medians(described: Described) -> dict[str, float | None]:
    """Median milliseconds of each stage that the descriptions name; None for those of ``STAGES`` that they lack."""
    times: dict[str, list[float]] = {stage: [] for stage in STAGES}
    for description in described.descriptions:
        for stage, spent in description.milliseconds.items():
            times.setdefault(stage, []).append(spent)
    return {stage: float(np.median(spent)) if spent else None for stage, spent in times.items()}


def best_first(runs: Sequence[SystemRun]) -> list[SystemRun]:
    """Runs by falling AUC-PR, then recall@1, then in their order."""
    return sorted(runs, key=lambda one: (-one.evaluation.auc_pr, -(one.evaluation.recall_at["1"] or 0)))


def _best_encoder(systems: Sequence[System], ranked: Sequence[SystemRun]) -> EncoderSystem | None:
    """The best of the encoders, whose regions are drawn; None without an encoder."""
    encoders = {system.identity: system for system in systems if isinstance(system, EncoderSystem)}
    return next((encoders[one.identity] for one in ranked if one.identity in encoders), None)


def _steps(subject: Subject, extras: Extras) -> int:
    steps = subject.steps
    if extras.scalability:
        steps += scale_steps(subject)
    if extras.severity:
        steps += severity_steps(subject)
    return steps


def _entry(measured: SystemMeasurement) -> CacheEntry:
    values = {name: value for name, value in vars(measured).items() if name != "scores"}
    return CacheEntry(values, {"scores": measured.scores})


def _loaded(entry: CacheEntry | None, subject: Subject) -> SystemMeasurement | None:
    if entry is None:
        return None
    try:
        measured = SystemMeasurement(scores=np.asarray(entry.arrays["scores"], np.float32), **entry.values)
    except (KeyError, TypeError):
        return None
    expected = (len(subject.pair.queries), len(subject.pair.retained))
    return measured if measured.scores.shape == expected else None
