"""The two stages of a search.

The first stage ranks all places of a map by the inner product of their descriptors with the query's (equation 3.12).
The second stage compares the best places of that ranking with the query cell by cell.

An encoder may screen more places than it compares (``core.method.agreement.promise``), and compare the most promising.

Where frames were taken densely, or the robot stood still, the neighbours of one place can fill the whole list of
candidates.  If the second stage compared only these, a similar place elsewhere would keep its low first score, the
best place would always have a large lead, and no answer would ever be ambiguous.  So the second stage goes on past the
neighbours of the best place until it has compared a few other places, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownPlace
from core.geometry.verification import Verification
from core.judgement.background import FULL
from core.judgement.geometry import Geometry
from core.judgement.priors import Values, weighed
from core.judgement.verdict import TOP_PLACES, Calibration
from core.maps import MapSettings, Selection
from core.method.agreement import Cells
from core.method.encoder import Encoder, Encoding
from core.places import Neighborhood, Whereabouts
from core.store import Map, Ranking, Scope
from core.store.snapshot import merged

Array = NDArray[np.float32]
Positions = NDArray[np.int64]

ROUNDS = 3
"""How often the other places are counted: one that is compared may become the best and have neighbours of its own."""

HEAD = 500
"""How many places of a ranking the second stage and the judgement see, unless too few are other than the best place."""


SEARCHES = 8
"""The most searches of a map for other places, where many frames show few views."""


@dataclass(frozen=True)
class Candidates:
    """The best places of a ranking after the second stage.

    rows: int64 [n], rows of the snapshot, best first.
    scores: float32 [n], the scores after both stages.
    first: float32 [n], those of the first stage; None where several frames were fused.
    whereabouts: the poses and sequences of these places.
    examined: bool [n], which of them the second stage has compared with the query.
    weights: float64 [n], the log prior of each place; None if the query had no prior.
    ordered: float32 [n], the values by which two stages order the places: the scores, changed by the prior.
    places: the number of places in the map, including those that the query may not find.
    geometry: the results of verification for the places, which are in the order of three stages then; None: none was
        verified.
    verifications: of the first places, in their order; None for one that was not verified.
    """

    rows: Positions
    scores: Array
    first: Array | None
    whereabouts: Whereabouts
    examined: NDArray[np.bool_]
    weights: Values | None
    ordered: Array
    places: int
    geometry: Geometry | None = None
    verifications: tuple[Verification | None, ...] = ()

    @property
    def agreement(self) -> Array | None:
        """The second stage's part of the scores, float32 [n]; None where it took no part, or is not known."""
        return None if self.first is None or not self.examined.any() else self.scores - self.first

    @property
    def values(self) -> NDArray[np.floating]:
        """The values by which the places are in their order, float [n]: ``ordered``, and the gains by geometry."""
        return self.ordered if self.geometry is None else self.ordered + self.geometry.gain

    @property
    def final_scores(self) -> NDArray[np.floating]:
        """The scores of all stages, float [n], without a prior."""
        return self.scores if self.geometry is None else self.scores + self.geometry.gain

    def examined_further(self, positions: Positions, gains: Array) -> Candidates:
        """The candidates in the same order, after the second stage has raised the scores at some positions.

        Args:
            positions: int64 [k], not examined before.
            gains: float32 [k].
        """
        raised, examined = np.zeros(len(self.rows), np.float32), self.examined.copy()
        raised[positions], examined[positions] = gains, True
        return replace(self, scores=self.scores + raised, ordered=self.ordered + raised, examined=examined)

    def believable(self) -> Candidates:
        """The candidates without frames that score less than it takes to believe them (``Whereabouts.least``)."""
        enough = self.scores >= self.whereabouts.least
        return self if enough.all() else self.take(np.flatnonzero(enough))

    def weighed(self, calibration: Calibration) -> Candidates:
        """The candidates in the order of both stages and the prior, which took from the scores of the first what there
        was above unrelated places, and takes the rest from what the second has added."""
        if self.weights is None:
            return self
        ordered = weighed(self.scores, self.weights, calibration)
        return replace(self, ordered=ordered).take(np.argsort(-ordered, kind="stable"))

    def with_geometry(self, geometry: Geometry, verifications: tuple[Verification | None, ...]) -> Candidates:
        """The candidates, which are in the order of three stages, with the results of their verification."""
        return replace(self, geometry=geometry, verifications=verifications)

    def take(self, retained: Positions) -> Candidates:
        """The candidates at some positions, int64 [m]."""
        return replace(
            self,
            rows=self.rows[retained],
            scores=self.scores[retained],
            first=None if self.first is None else self.first[retained],
            whereabouts=self.whereabouts.take(retained),
            examined=self.examined[retained],
            weights=None if self.weights is None else self.weights[retained],
            ordered=self.ordered[retained],
            geometry=None if self.geometry is None else self.geometry.take(retained),
            verifications=tuple(self.verifications[at] for at in retained.tolist() if at < len(self.verifications)),
        )


def calibration_of(map_: Map, encoder: Encoder) -> Calibration:
    """The map's own calibration or, if it has none, its encoder's."""
    return map_.record.calibration or encoder.calibration


def neighborhood_of(map_: Map) -> Neighborhood:
    """Which places count as the same place in a map, by distance or position in the sequence."""
    return Neighborhood(map_.record.same_place_radius, map_.record.same_place_frames, map_.record.same_place_height)


def rank_places(
    map_: Map, encoder: Encoder, encodings: Sequence[Encoding], selection: Selection | None = None
) -> list[Candidates]:
    """Both stages of the search for several queries, in one snapshot of a map.

    Args:
        encoder: the map's encoder.
        encodings: the queries, encoded by it, each with at least one region; at least one query.
        selection: the prior knowledge of the places; None: nothing.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    scope = map_.scope(selection)
    rankings = scope.search(np.stack([encoding.descriptor for encoding in encodings]))
    return [
        agree(map_, encoder, scope, encoding.descriptor, encoding.local, ranking)
        for encoding, ranking in zip(encodings, rankings, strict=True)
    ]


def agree(
    map_: Map,
    encoder: Encoder,
    scope: Scope,
    descriptor: Array,
    local: Cells,
    ranking: Ranking,
) -> Candidates:
    """The second stage: apply the prior, then compare the best places of a ranking with the query cell by cell.

    The best place's own neighbours may fill the shortlist of a map with codes, and frames of a few views.  Then the map
    is searched again, without them, for the other places that a verdict needs.

    Args:
        scope: the places that the query may find.
        descriptor: the query's, float32 [D].
        local: the query's local descriptors, int8 [C, L].
        ranking: the result of a search of the scope, rows int64 [n] and inner products float32 [n].

    Returns:
        The first ``HEAD`` places of the ranking if a verdict needs no more, else all of them.

    Raises:
        StorageFailure: local descriptors cannot be read from disk.
    """
    neighborhood = neighborhood_of(map_)
    candidates = _examined(map_, encoder, scope, local, ranking)
    if not len(candidates.rows) or _is_enough(candidates, neighborhood, encoder.candidates):
        return candidates
    best, listed = int(candidates.rows[0]), ranking
    # Looks at the best view may hide its neighbours, too, which a session follows.
    around = None if _crowded(candidates.whereabouts) else neighborhood
    for _ in range(SEARCHES):
        more = scope.search_elsewhere(descriptor, listed, best, around)
        if not len(more[0]):  # the ranking has all places
            break
        listed = merged(listed, more)
        places = scope.snapshot.whereabouts_at(np.append(best, listed[0]))
        if int(places.others(0, neighborhood).sum()) >= FULL:
            break
    return candidates if listed is ranking else _examined(map_, encoder, scope, local, listed)


def _examined(map_: Map, encoder: Encoder, scope: Scope, local: Cells, ranking: Ranking) -> Candidates:
    """The second stage over one ranking, see :func:`agree`."""
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    scores = encoder.scores_from_inner_products(ranking[1])
    snapshot, rows, ordered = scope.snapshot, ranking[0], scores
    if (weights := scope.weights_at(rows)) is not None:
        ordered = weighed(scores, weights, calibration)
        order = np.argsort(-ordered, kind="stable")
        rows, scores, ordered, weights = rows[order], scores[order], ordered[order], weights[order]

    def local_at(positions: Positions) -> Cells:
        return snapshot.locals_at(rows[positions])

    for length in (HEAD, len(rows)):
        places = snapshot.whereabouts_at(rows[:length])
        alone = scores[:length]
        found = examine(ordered[:length], places, neighborhood, *second_stage(encoder, local, local_at), alone=alone)
        order = found.order
        candidates = Candidates(
            rows[order],
            scores[order] + (found.scores - ordered[order]),
            scores[order],
            places.take(order),
            found.examined,
            None if weights is None else weights[order],
            found.scores,
            len(snapshot),
        ).believable()
        if length >= len(rows) or _is_enough(candidates, neighborhood, encoder.candidates):
            break
    return candidates.weighed(calibration)


def no_candidates(map_: Map) -> Candidates:
    """Those of a frame that is not searched for."""
    snapshot, none = map_.snapshot(), np.zeros(0, np.float32)
    rows = np.zeros(0, np.int64)
    examined = np.zeros(0, np.bool_)
    return Candidates(rows, none, none, snapshot.whereabouts_at(rows), examined, None, none, len(snapshot))


def likeness(map_: Map, encoder: Encoder, candidates: Candidates, positions: Positions) -> Array:
    """The scores of the best candidate, as if it were the query, at the candidates ``positions``, int64 [k].

    Returns:
        float32 [k], after both stages; zeros if one of the places has been deleted since the search.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    snapshot, rows = map_.snapshot(), candidates.rows[np.concatenate([[0], positions])]
    try:
        descriptors, local = snapshot.descriptors_at(rows), snapshot.locals_at(rows)
    except UnknownPlace:
        return np.zeros(len(positions), np.float32)
    return likeness_of_first(encoder, descriptors, local)


def likeness_of_first(encoder: Encoder, descriptors: Array, local: Cells) -> Array:
    """The scores of the first of n frames, as if it were the query, at the others, float32 [n - 1].

    Args:
        descriptors: float32 [n, D].
        local: int8 [n, C, L].
    """
    scores = encoder.scores_from_inner_products(descriptors[1:] @ descriptors[0])
    return scores + encoder.agreement(local[0], local[1:])


def _is_enough(candidates: Candidates, neighborhood: Neighborhood, examined: int) -> bool:
    """Whether the candidates have as many places other than the best place as a verdict considers.

    Among many frames of few views there are to be half as many as the second stage examines elsewhere, and enough that
    no place has to be imagined that the map has.

    Args:
        examined: how many places the second stage examines; 0: there is none.
    """
    others, places = candidates.whereabouts.others(0, neighborhood), candidates.whereabouts
    crowded = _crowded(places)
    wanted = max(TOP_PLACES, examined // 2) if crowded else TOP_PLACES
    if crowded and int(others.sum()) < FULL:
        return False
    return int((others & candidates.examined if examined else others).sum()) >= wanted


def _crowded(places: Whereabouts) -> bool:
    """Whether several of the places show one view."""
    return bool(places.repeats(np.arange(len(places))).any())


@dataclass(frozen=True)
class Examined:
    """A ranking of n places after the second stage.

    order: int64 [n], positions in the first stage's ranking, best first; equal scores keep their order.
    scores: float32 [n], in the new order.
    examined: bool [n], which places, in the new order, were compared with the query.
    """

    order: Positions
    scores: Array
    examined: NDArray[np.bool_]


class CellComparison(NamedTuple):
    """How the second stage of an encoder compares a query with the places of a ranking.

    candidates: how many places it examines; 0 if the encoder has no second stage.
    gains: returns the addition to the scores at positions in the ranking, int64 [k] to float32 [k], at least 0.
    screened: among how many of the first places it looks for those that it examines.
    promise: returns an estimate of the addition; None: the first places are examined.
    """

    candidates: int
    gains: Callable[[Positions], Array]
    screened: int = 0
    promise: Callable[[Positions], Array] | None = None


def second_stage(encoder: Encoder, query: Cells, local_at: Callable[[Positions], Cells]) -> CellComparison:
    """The second stage of an encoder for one query, int8 [C, L].

    Args:
        local_at: returns the local descriptors at positions in the ranking, int64 [k] to int8 [k, C, L].
    """

    read = np.zeros((0, *query.shape), np.int8)  # of the places that were screened
    numbers: dict[int, int] = {}

    def promise(positions: Positions) -> Array:
        nonlocal read
        read = local_at(positions)
        numbers.update(zip(positions.tolist(), range(len(positions)), strict=True))
        return encoder.promise(query, read)

    def gains(positions: Positions) -> Array:
        known = [numbers[position] for position in positions.tolist() if position in numbers]
        return encoder.agreement(query, read[known] if len(known) == len(positions) else local_at(positions))

    return CellComparison(encoder.candidates, gains, encoder.screened, promise)


def examine(
    scores: Array,
    whereabouts: Whereabouts,
    neighborhood: Neighborhood,
    candidates: int,
    gains: Callable[[Positions], Array],
    screened: int = 0,
    promise: Callable[[Positions], Array] | None = None,
    others: int = TOP_PLACES,
    alone: Array | None = None,
) -> Examined:
    """Raise the scores of the best places of a ranking by the gains of the second stage.

    It examines the first ``candidates`` places or, if more are ``screened``, the most promising of these; of several
    frames of one view first one, and another in the place of one that turns out not to be believed.  As long as fewer
    than ``others`` of the examined places are other than the best place, it then examines the next that are.

    Args:
        scores: float32 [n], the scores of the first stage, best first.
        whereabouts: the poses and sequences of the n places.
        neighborhood: which places count as the same place.
        candidates, gains, screened, promise: as of :class:`CellComparison`.
        others: how many of the examined places have to be other than the best place, if the map has that many.
        alone: float32 [n], the scores of the first stage without a prior, by which frames are believed; None: there is
            no prior.
    """
    raised = scores.copy()
    done = np.zeros(len(scores), np.bool_)
    queue = _views_first(whereabouts, np.arange(len(scores)))  # in the order in which places are examined
    if promise is not None and candidates < min(screened, len(queue)):
        first = queue[:screened]
        promising = first[np.argsort(-(scores[first] + promise(first)), kind="stable")]
        queue[:screened] = _views_first(whereabouts, promising)
    ahead = queue[:candidates]
    for _ in range(ROUNDS):
        if not len(ahead):
            break
        while len(ahead):
            raised[ahead] += gains(ahead)
            done[ahead] = True
            denied = done & ((raised if alone is None else alone + (raised - scores)) < whereabouts.least)
            ahead = _instead(queue, whereabouts, done, denied)
        counted = done if denied[done].all() else done & ~denied
        best = int(np.flatnonzero(counted)[np.argmax(raised[counted])])
        elsewhere = whereabouts.others(best, neighborhood)
        missing = max(0, others - int((done & elsewhere).sum()))
        ahead = queue[(elsewhere & ~done)[queue]][:missing]
    order = np.argsort(-raised, kind="stable")
    return Examined(order, raised[order], done[order])


def _instead(
    queue: Positions, whereabouts: Whereabouts, done: NDArray[np.bool_], denied: NDArray[np.bool_]
) -> Positions:
    """The next frame of each view of which some frames were examined and none is believed."""
    if not denied.any():
        return queue[:0]
    views = whereabouts.view_keys()
    lacking = np.setdiff1d(views[denied], views[done & ~denied])
    waiting = queue[~done[queue] & np.isin(views[queue], lacking)]
    return waiting[~whereabouts.repeats(waiting)]


def _views_first(whereabouts: Whereabouts, queue: Positions) -> Positions:
    """The places in their order, but further frames of a view behind the first ones of all views."""
    again = whereabouts.repeats(queue)
    return np.concatenate([queue[~again], queue[again]])


def score_matrix(encoder: Encoder, inner_products: Array, queries: Cells, references: Cells) -> Array:
    """Both stages for every query against every frame of one traverse, as a map of that traverse would score them.

    The evaluation compares this matrix: the frames of the references are the places of one sequence without poses.

    Args:
        inner_products: of the descriptors, float32 [Q, R].
        queries, references: local descriptors, int8 [Q, C, L] and [R, C, L].

    Returns:
        Scores, float32 [Q, R].
    """
    scores = encoder.scores_from_inner_products(inner_products)
    if encoder.candidates:
        for row, found in zip(scores, traverse_candidates(encoder, inner_products, queries, references), strict=True):
            row[found.rows] = found.scores
    return scores


def traverse_neighborhood() -> Neighborhood:
    """Which frames of a traverse are the same place, as in a map with the settings of a new one."""
    settings = MapSettings()
    return Neighborhood(settings.same_place_radius, settings.same_place_frames)


def traverse_candidates(
    encoder: Encoder, inner_products: Array, queries: Cells, references: Cells
) -> Iterator[Candidates]:
    """The ranking of every query after both stages, as a map of the references would give it; its rows are all of them.

    Args:
        encoder: with a second stage.
        inner_products, queries, references: as of :func:`score_matrix`.
    """
    places = Whereabouts.along_sequence(np.arange(len(references)))
    neighborhood = traverse_neighborhood()
    for first, query in zip(encoder.scores_from_inner_products(inner_products), queries, strict=True):
        order = np.argsort(-first, kind="stable")

        def local_at(positions: Positions, order: Positions = order) -> Cells:
            return references[order[positions]]

        found = examine(first[order], places.take(order), neighborhood, *second_stage(encoder, query, local_at))
        rows = order[found.order]
        ranked = rows, found.scores, first[rows], places.take(rows), found.examined
        yield Candidates(*ranked, weights=None, ordered=found.scores, places=len(references))
