"""Verdicts and probabilities of an encoder in maps of any size, by the calibration that it ships.

A map is a run of neighbouring references.  It gets queries whose place it holds, and strangers: queries whose true
references are all more than ``APART`` frames from any that it holds.  Both kinds count alike in the calibration error,
as they did when the calibration was measured.  All of it is measured by two stages, and again with the best candidates
verified geometrically.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.geometry.pairs import Pairs
from core.judgement.reliability import BINS
from core.judgement.verdict import Judgement, judge
from core.maps import MapSettings
from core.networks.xfeat import load_xfeat
from core.places import Neighborhood, Whereabouts
from core.recognition.question import Verifier
from core.recognition.stages import Candidates, examine, second_stage
from core.recognition.verification import CANDIDATES, verify_candidates
from lab.baselines.encoders import EncoderSystem, local_of
from lab.baselines.system import stack
from lab.evaluation.cache import CacheEntry, EvaluationCache, arrays_digest
from lab.evaluation.protocol.comparison import SizePoint
from lab.evaluation.subject import Subject

if TYPE_CHECKING:
    from core.method.encoder import Encoder

Positions = NDArray[np.int64]

SIZES = (1, 2, 5, 10, 30, 100)
APART = 8
MAPS = 6
"""Maps of each size, but one of all references."""

MOST_QUERIES = 20
"""The largest number of queries of either kind on a map; they are drawn at random."""


def map_sizes(subject: Subject, cache: EvaluationCache, seed: int = 0) -> list[SizePoint]:
    """The points of one system by rising size; none for a system that ships no probabilities.

    There are none, either, where queries are not matched against all references: a map has no such exceptions.

    Args:
        seed: of the draw of maps and queries.
    """
    system = subject.system
    if not isinstance(system, EncoderSystem) or system.encoder.calibration.curve is None or subject.pair.excluded:
        return []
    key = subject.key(
        "map-sizes",
        seed=seed,
        calibration=system.encoder.calibration.model_dump(),
        candidates=CANDIDATES,
        truth=arrays_digest(subject.pair.truth),
        retained=subject.pair.retained.tolist(),
    )
    entry = cache.load(key)
    if entry is not None:
        return [SizePoint(**point) for point in entry.values["points"]]
    maps = _Maps(subject, system.encoder)
    references = len(subject.pair.retained)
    sizes = [size for size in SIZES if size < references] + [references]
    points = [point for size in sizes if (point := maps.point(size, np.random.default_rng((seed, size)))) is not None]
    cache.store(key, CacheEntry({"points": [asdict(point) for point in points]}))
    return points


class _Maps:
    """Maps of the references of one subject, and the queries against them."""

    def __init__(self, subject: Subject, encoder: Encoder) -> None:
        self.encoder, self.name, self.retained = encoder, subject.about.name, subject.pair.retained
        self.truth = [np.asarray(true, np.int64) for true in subject.pair.truth]
        references, queries = subject.references.descriptions, subject.queries.descriptions
        self.products = stack(queries) @ stack(references).T
        cells = bool(encoder.candidates)
        empty = np.zeros((len(references), 0, 0), np.int8), np.zeros((len(queries), 0, 0), np.int8)
        self.local, self.queried = (local_of(references), local_of(queries)) if cells else empty
        self.pairs = _pairs(subject) if encoder.calibration.geometry is not None else None
        settings = MapSettings()
        self.neighborhood = Neighborhood(settings.same_place_radius, settings.same_place_frames)

    def point(self, size: int, generator: np.random.Generator) -> SizePoint | None:
        """The figures of maps of one size; None if no query has its place in one."""
        knowns: list[bool] = []
        outcomes: list[list[tuple[bool, bool, float]]] = []
        for start in generator.integers(
            0, len(self.retained) - size + 1, MAPS if size < len(self.retained) else 1
        ).tolist():
            part = np.arange(start, start + size)
            for queries, there in self._queries(part):
                for query in generator.permutation(queries)[:MOST_QUERIES].tolist():
                    knowns.append(there)
                    outcomes.append(
                        [
                            (
                                there and bool(np.isin(best, self.truth[query])),
                                found.verdict == "recognized",
                                found.probability or 0.0,
                            )
                            for found, best in self._judged(query, part)
                        ]
                    )
        known = np.array(knowns, np.bool_)
        if not known.any():
            return None
        figures = [_figures(list(stage), known) for stage in zip(*outcomes, strict=True)]
        two, three = figures[0], figures[1] if len(figures) > 1 else (None, None, None)
        assert two[0] is not None
        return SizePoint(self.name, size, int(known.sum()), int((~known).sum()), two[0], two[1], two[2], *three)

    def _queries(self, part: Positions) -> Iterator[tuple[Positions, bool]]:
        """The queries whose place is among the references, and the strangers; int64 each."""
        held = self.retained[part]
        around = np.arange(held.min() - APART, held.max() + APART + 1)
        yield np.flatnonzero([bool(np.isin(true, held).any()) for true in self.truth]), True
        yield np.flatnonzero([bool(len(true)) and not np.isin(true, around).any() for true in self.truth]), False

    def _judged(self, query: int, part: Positions) -> list[tuple[Judgement, int]]:
        """The judgement of a query against the references ``part``, and the index of the best match.

        By two stages; and by three, if candidates can be verified.
        """
        encoder = self.encoder
        scores = np.asarray(encoder.scores_from_inner_products(self.products[query, part]), np.float32)
        order = np.argsort(-scores, kind="stable")
        rows = part[order]
        places = Whereabouts.along_sequence(self.retained[rows])

        stage = second_stage(encoder, self.queried[query], lambda at: self.local[rows[at]])
        seen = examine(scores[order], places, self.neighborhood, *stage)
        ranked = rows[seen.order]
        candidates = Candidates(
            ranked, seen.scores, scores[order][seen.order], places.take(seen.order), seen.examined, None, seen.scores,
            len(rows),
        )  # fmt: skip

        def judged(candidates: Candidates) -> Judgement:
            return judge(
                candidates.ordered,
                candidates.whereabouts,
                encoder.calibration,
                self.neighborhood,
                candidates.examined,
                geometry=candidates.geometry,
            )

        found = [(judged(candidates), int(self.retained[ranked[0]]))]
        if (pairs := self.pairs) is not None:

            def agreements(places: Sequence[int]) -> NDArray[np.float32]:
                return encoder.agreement(self.queried[query], self.local[list(places)])

            final, judgement, _ = verify_candidates(
                candidates,
                judged,
                Verifier("always", lambda: pairs.queries[query]),
                encoder.calibration,
                pairs.comparison(query, agreements),
            )
            found.append((judgement, int(self.retained[final.rows[0]])))
        return found


def _pairs(subject: Subject) -> Pairs:
    """The keypoints of the queries and of the retained references."""
    network = load_xfeat()

    def keypoints(paths: Sequence[Path]) -> list[Keypoints]:
        return [find_keypoints(network, subject.frame(path)) for path in paths]

    return Pairs(keypoints(subject.pair.queries), keypoints(subject.pair.retained_references))


def _figures(
    outcomes: Sequence[tuple[bool, bool, float]], known: NDArray[np.bool_]
) -> tuple[float, float | None, float | None]:
    """Shares of the known that are recognized and right, and of the strangers that are recognized, and the error.

    Args:
        outcomes: of each query whether the best match is right, whether it was recognized, and the probability.
        known: bool [n], whether its place was in the map.
    """
    hits, believed = (np.array([one[column] for one in outcomes], np.bool_) for column in range(2))
    right = float((believed & hits)[known].mean())
    if known.all():
        return right, None, None
    error = balanced_error(np.array([one[2] for one in outcomes]), hits, known)
    return right, float(believed[~known].mean()), error


def balanced_error(probabilities: NDArray[np.float64], right: NDArray[np.bool_], known: NDArray[np.bool_]) -> float:
    """The expected calibration error if known and unknown queries, of which there are both, count alike.

    Args:
        probabilities: float64 [n], that each best match is right.
        right, known: bool [n], whether it is, and whether the place was there.
    """
    weights = np.where(known, 0.5 / known.sum(), 0.5 / (~known).sum())
    bins = np.minimum((probabilities * BINS).astype(np.int64), BINS - 1)
    return float(np.abs(np.bincount(bins, weights * (probabilities - right), BINS)).sum())
