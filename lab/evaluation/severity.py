"""Accuracy as the queries are disturbed more and more (thesis, section 5.2, item 3)."""

from __future__ import annotations

from collections.abc import Sequence

from core.judgement.curves import auc_pr
from lab.baselines.system import ReferenceIndex
from lab.evaluation.cache import CacheEntry, EvaluationCache
from lab.evaluation.data.disturbances import DISTURBANCES, Disturbance
from lab.evaluation.protocol.comparison import SeverityCurve
from lab.evaluation.protocol.figures import recall_at_k
from lab.evaluation.protocol.outcomes import best_matched, best_scores, judge
from lab.evaluation.subject import Described, Subject


def severity(
    subject: Subject,
    cache: EvaluationCache,
    disturbances: Sequence[Disturbance] = DISTURBANCES,
    seed: int = 0,
) -> list[SeverityCurve]:
    """One curve for each disturbance of the query traverse; the references stay as they are."""
    curves = []
    for disturbance in disturbances:
        key = subject.key(
            "severity",
            disturbance=disturbance.name,
            levels=disturbance.levels,
            seed=seed,
            retained=subject.pair.retained.tolist(),
            **subject.judged_by,
        )
        curve = _loaded(cache.load(key), disturbance, subject)
        if curve is None:
            curve = _curve(subject, disturbance, seed)
            cache.store(key, CacheEntry({"recall_at_1": curve.recall_at_1, "auc_pr": curve.auc_pr}))
        curves.append(curve)
    return curves


def severity_steps(subject: Subject, disturbances: Sequence[Disturbance] = DISTURBANCES) -> int:
    """How many images are described and scored for the curves; the undisturbed ones are only scored."""
    return len(subject.pair.queries) * sum(2 * len(disturbance.levels) - 1 for disturbance in disturbances)


def _curve(subject: Subject, disturbance: Disturbance, seed: int) -> SeverityCurve:
    index = subject.system.index(subject.references.descriptions)
    points = [_point(subject, index, _disturbed(subject, disturbance, level, seed)) for level in disturbance.levels]
    recalls, areas = zip(*points, strict=True)
    return SeverityCurve(
        disturbance=disturbance.name,
        system=subject.about.name,
        levels=list(disturbance.levels),
        unit=disturbance.unit,
        recall_at_1=list(recalls),
        auc_pr=list(areas),
    )


def _disturbed(subject: Subject, disturbance: Disturbance, level: float, seed: int) -> Described:
    if level == disturbance.levels[0]:
        return subject.queries
    return subject.describe(
        subject.pair.queries, lambda pixels, number: disturbance.changed(pixels, level, seed, number)
    )


def _point(subject: Subject, index: ReferenceIndex, queries: Described) -> tuple[float, float]:
    """recall@1 (0 where no query has a true reference) and AUC-PR."""
    scores = subject.score(index, queries.descriptions).scores
    outcomes = judge(scores, subject.pair.retained, subject.pair.truth, subject.pair.excluded)
    area = auc_pr(best_scores(outcomes), best_matched(outcomes))
    return recall_at_k(outcomes, 1) or 0.0, area


def _loaded(entry: CacheEntry | None, disturbance: Disturbance, subject: Subject) -> SeverityCurve | None:
    if entry is None:
        return None
    try:
        return SeverityCurve(
            disturbance=disturbance.name,
            system=subject.about.name,
            levels=list(disturbance.levels),
            unit=disturbance.unit,
            recall_at_1=entry.values["recall_at_1"],
            auc_pr=entry.values["auc_pr"],
        )
    except KeyError:
        return None
