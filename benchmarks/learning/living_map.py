"""A map whose places get further looks: the small interface that the benchmark needs of one, and one in memory.

Until a store keeps several looks of a place, a look is a further frame at the position of the place in its sequence,
which is how a store keeps frames that show one view.  Encodings and keypoints are what a service computes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.belief import Evidence, PlaceGraph, evidence, place_graph, sighted
from core.belief.evidence import believable_score
from core.geometry.keypoints import LENGTH, Keypoints
from core.geometry.matching import GLANCED, count_matches, glance_at
from core.geometry.verification import LEAST_MATCHES, Verification, verify
from core.judgement.background import GUARD_FACTOR
from core.judgement.verdict import Judgement, judge
from core.maps import MapSettings
from core.method.agreement import Cells
from core.method.encoder import Encoder
from core.places import METRIC, Neighborhood, Whereabouts
from core.recognition.question import Verifier
from core.recognition.stages import Candidates, examine, likeness_of_first, second_stage
from core.recognition.verification import verify_candidates

SAME_PLACE = Neighborhood(MapSettings().same_place_radius, MapSettings().same_place_frames)
HEAD = 500


class EncodedPicture(NamedTuple):
    """An encoded frame: descriptor float32 [D], local descriptors int8 [C, L], and keypoints, or None."""

    descriptor: NDArray[np.float32]
    local: Cells
    keypoints: Keypoints | None


class Recognized(NamedTuple):
    """The answer to one frame: its judgement, the best row, its evidence, and the score of a believable place."""

    judgement: Judgement
    row: int
    seen: Evidence
    believable: float


@dataclass
class _Rows:
    """Columns of the rows of a map, with room for more."""

    descriptors: NDArray[np.float32]
    local: Cells
    glances: NDArray[np.int8]


class LivingMap:
    """Places of one sequence with poses, in memory; each has its first look and those that were learnt.

    place: the number of the place that each row shows.
    """

    def __init__(
        self,
        encoder: Encoder,
        frames: Sequence[EncodedPicture],
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
    ) -> None:
        """``positions``: metres, float64 [n, 2]; ``headings``: radians counter-clockwise from +x, float64 [n]."""
        self.encoder = encoder
        self.positions, self.headings = positions, headings
        self.place: list[int] = []
        self.alive: list[bool] = []
        self.keypoints: list[Keypoints | None] = []
        self.least: list[float] = []
        size = 4 * len(frames)
        one = frames[0]
        self._rows = _Rows(
            np.zeros((size, len(one.descriptor)), np.float32),
            np.zeros((size, *one.local.shape), np.int8),
            np.zeros((size, GLANCED, LENGTH), np.int8),
        )
        for place, frame in enumerate(frames):
            self.add_look(place, frame)

    def __len__(self) -> int:
        return sum(self.alive)

    def add_look(self, place: int, frame: EncodedPicture, least: float = -np.inf) -> int:
        """Add a look of a place, which is believed from a score of ``least`` on; its row."""
        row, rows = len(self.place), self._rows
        if row == len(rows.descriptors):
            for name, column in vars(rows).items():
                setattr(rows, name, np.concatenate([column, np.zeros_like(column)]))
        rows.descriptors[row], rows.local[row] = frame.descriptor, frame.local
        if frame.keypoints is not None:
            rows.glances[row] = glance_at(frame.keypoints)
        self.place.append(place)
        self.least.append(least)
        self.alive.append(True)
        self.keypoints.append(frame.keypoints)
        return row

    def withdraw_look(self, row: int) -> None:
        """Take a look away again."""
        self.alive[row] = False

    @property
    def living(self) -> NDArray[np.int64]:
        """The rows that are there, int64 [n]."""
        return np.flatnonzero(self.alive)

    @property
    def whereabouts(self) -> Whereabouts:
        """Of all rows."""
        place, count = np.array(self.place), len(self.place)
        return Whereabouts(
            np.full(count, METRIC, np.int8),
            np.column_stack([self.positions[place], np.zeros(count)]),
            np.zeros(count, np.int32),
            place.astype(np.int64),
            np.degrees(self.headings[place]).astype(np.float32) % 360,
            least=np.array(self.least, np.float32),
        )

    def graph(self) -> PlaceGraph:
        """The places with their ways."""
        return place_graph(self.whereabouts, self.living, len(self.place), SAME_PLACE)

    def recognize(self, frames: Sequence[EncodedPicture]) -> list[Recognized]:
        """The answers to frames, alone; verified where two stages leave doubt."""
        living, where = self.living, self.whereabouts
        descriptors = self._rows.descriptors[: len(self.place)]
        first = self.encoder.scores_from_inner_products(np.stack([one.descriptor for one in frames]) @ descriptors.T)
        return [self._answer(frame, scores[living], living, where) for frame, scores in zip(frames, first, strict=True)]

    def _answer(
        self, frame: EncodedPicture, scores: NDArray[np.float32], living: NDArray[np.int64], where: Whereabouts
    ) -> Recognized:
        order = np.argsort(-scores, kind="stable")[:HEAD]
        rows, listed = living[order], where.take(living[order])
        stage = second_stage(self.encoder, frame.local, lambda at: self._rows.local[rows[at]])
        found = examine(scores[order], listed, SAME_PLACE, *stage)
        candidates = Candidates(
            rows[found.order],
            found.scores,
            scores[order][found.order],
            listed.take(found.order),
            found.examined,
            None,
            found.scores,
            len(living),
        ).believable()
        calibration = self.encoder.calibration

        def judged(candidates: Candidates) -> Judgement:
            def likeness(at: NDArray[np.int64]) -> NDArray[np.float32]:
                some = candidates.rows[np.concatenate([[0], at])]
                return likeness_of_first(self.encoder, self._rows.descriptors[some], self._rows.local[some])

            return judge(
                candidates.ordered,
                candidates.whereabouts,
                calibration,
                SAME_PLACE,
                candidates.examined,
                likeness,
                candidates.geometry,
            )

        judgement = judged(candidates)
        if frame.keypoints is not None:
            keypoints = frame.keypoints
            candidates, judgement, _ = verify_candidates(
                candidates,
                judged,
                Verifier("auto", lambda: keypoints),
                calibration,
                RowComparison(self.encoder, frame, self._rows.local, self._rows.glances, self.keypoints),
            )
        seen = evidence(
            candidates.rows,
            candidates.scores,
            candidates.whereabouts,
            calibration,
            SAME_PLACE,
            candidates.examined,
            None if candidates.geometry is None else candidates.geometry.evidence,
            [place for group in judgement.rivals if group.same_place for place in group.positions],
        )
        compared = candidates.whereabouts.others(0, SAME_PLACE) & candidates.examined
        apart = compared & ~candidates.whereabouts.near(0, SAME_PLACE.times(GUARD_FACTOR))
        falling = np.sort(candidates.scores[compared].astype(np.float64))[::-1]
        _, believable = believable_score(
            falling, int(compared.sum()), calibration, candidates.scores[apart].astype(np.float64)
        )
        return Recognized(judgement, int(candidates.rows[0]), sighted(seen, candidates.rows, judgement), believable)

    def scores_between(self, one: EncodedPicture, others: Sequence[EncodedPicture]) -> NDArray[np.float32]:
        """The scores of both stages of a frame against others, float32 [k]."""
        if not others:
            return np.zeros(0, np.float32)
        descriptors = np.stack([one.descriptor, *(other.descriptor for other in others)])
        return likeness_of_first(self.encoder, descriptors, np.stack([one.local, *(other.local for other in others)]))


@dataclass(frozen=True)
class RowComparison:
    """Compares a frame with rows of a map in memory (``core.recognition.comparison.Comparison``)."""

    encoder: Encoder
    frame: EncodedPicture
    local: Cells
    glances: NDArray[np.int8]
    keypoints: Sequence[Keypoints | None]

    def matches_at_a_glance(self, rows: Sequence[int]) -> NDArray[np.int64]:
        assert self.frame.keypoints is not None
        return count_matches(self.frame.keypoints, self.glances[list(rows)])

    def agreements(self, rows: Sequence[int]) -> NDArray[np.float32]:
        return self.encoder.agreement(self.frame.local, self.local[list(rows)])

    def verifications(self, rows: Sequence[int]) -> list[Verification | None]:
        ours = self.frame.keypoints
        there = {row: one for row in rows if (one := self.keypoints[row]) is not None}
        if ours is None or len(ours) < LEAST_MATCHES or not there:
            return [None] * len(rows)
        found = dict(zip(there, verify(ours, list(there.values())), strict=True))
        return [found.get(row) for row in rows]
