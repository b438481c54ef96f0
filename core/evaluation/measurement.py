"""One system measured on one pair of traverses: scores, times, bytes; kept, so that it is done once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.evaluation.cache import CacheEntry, EvaluationCache
from core.evaluation.protocol.comparison import Run
from core.evaluation.protocol.figures import STAGES, summarize
from core.evaluation.protocol.outcomes import judge
from core.evaluation.protocol.trust import trust_figures
from core.evaluation.subjects import Described, Subject


@dataclass(frozen=True)
class Measurement:
    """What is measured, without judging it.

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


def measure(subject: Subject) -> Measurement:
    """Describe the kept references, describe the queries, match each query against all references."""
    references, queries = subject.references, subject.queries
    index = subject.system.index(references.descriptions)
    compared = subject.compare(index, queries.descriptions)
    sizes = [description.nbytes for description in references.descriptions]
    return Measurement(
        identity=subject.system.identity,
        scores=compared.scores,
        bytes_per_place=round(sum(sizes) / len(sizes)),
        milliseconds={**stage_medians(queries), "match": float(np.median(compared.milliseconds))},
        describe_milliseconds=float(np.median(queries.milliseconds)),
    )


def stage_medians(described: Described) -> dict[str, float | None]:
    """Median milliseconds of each stage that a description tells of; None for those of ``STAGES`` that it lacks."""
    times: dict[str, list[float]] = {stage: [] for stage in STAGES}
    for description in described.descriptions:
        for stage, spent in description.milliseconds.items():
            times.setdefault(stage, []).append(spent)
    return {stage: float(np.median(spent)) if spent else None for stage, spent in times.items()}


def run(subject: Subject, cache: EvaluationCache) -> Run:
    """The figures of a subject; measured now, or taken from the cache with the times of then."""
    key = subject.key("run")
    measurement = _loaded(cache.load(key), subject)
    cached = measurement is not None
    if measurement is None:
        measurement = measure(subject)
        cache.store(key, _entry(measurement))
    outcomes = judge(measurement.scores, subject.pair.kept, subject.pair.truth)
    evaluation = summarize(
        measurement.identity,
        outcomes,
        len(subject.pair.kept),
        measurement.milliseconds,
        describe_milliseconds=measurement.describe_milliseconds,
        bytes_per_place=measurement.bytes_per_place,
        trained_on=subject.trained_on,
    )
    trusted = trust_figures(measurement.scores, subject.pair.kept, outcomes, evaluation.notes)
    evaluation = evaluation.model_copy(update=trusted)
    return Run(
        about=subject.about,
        identity=measurement.identity,
        evaluation=evaluation,
        outcomes=outcomes,
        scores=measurement.scores,
        bytes_per_place=measurement.bytes_per_place,
        milliseconds=evaluation.milliseconds,
        cached=cached,
    )


def best_first(runs: Sequence[Run]) -> list[Run]:
    """Runs by falling AUC-PR, then recall@1, then as they stand."""
    return sorted(runs, key=lambda one: (-one.evaluation.auc_pr, -(one.evaluation.recall_at["1"] or 0)))


def _entry(measurement: Measurement) -> CacheEntry:
    values = {name: value for name, value in vars(measurement).items() if name != "scores"}
    return CacheEntry(values, {"scores": measurement.scores})


def _loaded(entry: CacheEntry | None, subject: Subject) -> Measurement | None:
    if entry is None:
        return None
    try:
        measurement = Measurement(scores=np.asarray(entry.arrays["scores"], np.float32), **entry.values)
    except (KeyError, TypeError):
        return None
    expected = (len(subject.pair.queries), len(subject.pair.kept))
    return measurement if measurement.scores.shape == expected else None
