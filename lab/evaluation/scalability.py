"""Accuracy and matching time as the traverses grow (thesis, Fig. 3.9)."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from core.judgement.curves import auc_pr
from lab.evaluation.cache import CacheEntry, EvaluationCache
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.protocol.comparison import ScalePoint
from lab.evaluation.protocol.figures import recall_at_k
from lab.evaluation.protocol.outcomes import best_matched, best_scores, judge
from lab.evaluation.subject import Subject

POINTS = 6
FEWEST = 8
"""References of the smallest traverse."""


def scale_sizes(references: int, points: int = POINTS) -> list[int]:
    """Numbers of references, evenly spaced on a logarithmic scale up to all of them."""
    if references <= FEWEST:
        return [references]
    return sorted({round(size) for size in np.geomspace(FEWEST, references, points)})


def scalability(subject: Subject, cache: EvaluationCache) -> list[ScalePoint]:
    """The system on the first few places of the traverses, on more, on all.

    A point has the first retained references, and the queries with a true one among them: both
    traverses grow together, and no query becomes a new place because its reference is not reached.
    """
    sizes = scale_sizes(len(subject.pair.retained))
    key = subject.key("scalability", sizes=sizes, retained=subject.pair.retained.tolist(), **subject.judged_by)
    entry = cache.load(key)
    if entry is not None:
        return [ScalePoint(**point) for point in entry.values["points"]]
    points = [_point(subject, size) for size in sizes if _answerable(subject.pair, size)]
    cache.store(key, CacheEntry({"points": [asdict(point) for point in points]}))
    return points


def scale_steps(subject: Subject) -> int:
    """How many queries are scored for the points."""
    return sum(len(_answerable(subject.pair, size)) for size in scale_sizes(len(subject.pair.retained)))


def _answerable(pair: TraversePair, size: int) -> list[int]:
    """The queries with a true reference among the first ``size`` that are retained."""
    retained = pair.retained[:size]
    return [number for number, true in enumerate(pair.truth) if np.isin(true, retained).any()]


def _point(subject: Subject, size: int) -> ScalePoint:
    """The point of the first ``size`` retained references."""
    retained, answerable = subject.pair.retained[:size], _answerable(subject.pair, size)
    index = subject.system.index(subject.references.descriptions[:size])
    scored = subject.score(index, [subject.queries.descriptions[number] for number in answerable])
    truth, excluded = subject.pair.truth, subject.pair.excluded
    left_out = None if excluded is None else [excluded[number] for number in answerable]
    outcomes = judge(scored.scores, retained, [truth[number] for number in answerable], left_out)
    return ScalePoint(
        system=subject.about.name,
        references=size,
        queries=len(answerable),
        auc_pr=auc_pr(best_scores(outcomes), best_matched(outcomes)),
        recall_at_1=recall_at_k(outcomes, 1),
        milliseconds=float(np.median(scored.milliseconds)),
    )
