"""Calibration of a map: queries whose place is known are searched for, and the answers show when to believe one.

Every query is searched for twice: in the map as it is, and in the map without the query's place, so that there are as
many unknown places as known ones.  With the place everything is left out that lies within three times the distance that
counts as the same place, for the next frames of a traverse still show the same corner.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from core.errors import CalibrationImpossible, UnknownPlace, UnknownSequence
from core.geometry.keypoints import Keypoints
from core.judgement.background import GUARD_FACTOR
from core.judgement.calibration import (
    FEWEST_OF_A_KIND,
    FittedCalibration,
    Kinds,
    Target,
    adjust_calibration,
    fit_map_calibration,
)
from core.judgement.trials import StagedTrials, Trial, gathered, joined_stages
from core.judgement.verdict import Calibration, Judgement, judge
from core.maps import PlaceFilter, own_poses
from core.method.agreement import Cells
from core.method.encoder import Encoder, Encoding
from core.places import NO_POSE
from core.recognition.comparison import MapComparison
from core.recognition.question import Verifier
from core.recognition.stages import Candidates, agree, calibration_of, neighborhood_of
from core.recognition.verification import verify_candidates
from core.store import Map, Ranking, Scope, Snapshot

Item = TypeVar("Item")
Flags = NDArray[np.bool_]
ProgressCallback = Callable[[int, int], None]
"""Called with the number of queries done, and the number of all queries."""

TOGETHER = 16
"""The number of queries that are searched for at a time."""

FEW_FRAMES = 50
"""A calibration from fewer frames comes with a warning."""

DRAWN = 3
"""Every third labelled frame of a place is a stranger, too: it is asked in the map without its place."""

FROM_ITSELF = (
    "The frames are the map's own: one walk in one light. A second visit differs more, so the probabilities are too "
    "high; calibrate from a second traverse or from labelled frames as soon as there are any."
)
"""The warning of a calibration from the map's own frames."""


FROM_RUNS = (
    "Which places the frames show is known from the frames before and after them, and from odometry: where a run errs, "
    "these figures err with it."
)
"""The warning of a calibration from the runs of robots."""

FROM_DOUBT = (
    "The labelled frames are those that were stored for review; without recognized ones among them they are harder "
    "than the frames that come."
)
"""The warning of a calibration from the frames of review."""


@dataclass(frozen=True)
class LabelledQuery:
    """One query whose place is known.

    descriptor: float32 [D].
    local: the local descriptors, int8 [C, L].
    true: bool [rows], the rows of the snapshot that show the query's place; none, if the map lacks it.
    absent: bool [rows], rows that are always left out, such as the query's own.
    around: bool [rows], rows that are left out as well to make the place unknown.
    keypoints: of its frame; None: they are not known, and nothing is verified.
    """

    descriptor: NDArray[np.float32]
    local: Cells
    true: Flags
    absent: Flags
    around: Flags
    keypoints: Keypoints | None = None


@dataclass(frozen=True)
class LabelledQueries:
    """The queries of a calibration.

    count: how many there are.
    made: the queries; each is read when it is needed.
    allowed: bool [rows], the rows that are searched; None: all.
    aligned: how many of the queries have no pose of their own, so that an alignment says which place they show.
    """

    count: int
    made: Iterator[LabelledQuery]
    allowed: Flags | None = None
    aligned: int = 0


def queries_from_labels(
    map_: Map,
    snapshot: Snapshot,
    encodings: Sequence[Encoding],
    places: Sequence[str | None],
    own: Sequence[str | None] | None = None,
    keypoints: Sequence[Keypoints | None] | None = None,
) -> LabelledQueries:
    """The queries of a calibration from labelled frames.

    Args:
        encodings: the frames, encoded by the map's encoder.
        places: for each frame the id of the place that it shows; None if the map lacks the place.
        own: for each frame the place, or the address of the look, whose frame it is itself, which is then left out;
            None: none is.
        keypoints: of each frame, for maps that verify; None: not known.

    Raises:
        UnknownPlace: the map has no place of one of the ids.
    """
    rows = _rows_of(map_, snapshot, [place for place in places if place is not None])
    own_rows = [None if one is None else map_.rows_of([one])[0] for one in own or [None] * len(places)]
    shown = [None if place is None else rows[place] for place in places]
    return queries_from_rows(map_, snapshot, encodings, shown, own_rows, keypoints)


def queries_from_rows(
    map_: Map,
    snapshot: Snapshot,
    encodings: Sequence[Encoding],
    rows: Sequence[int | None],
    own: Sequence[int | None] | None = None,
    keypoints: Sequence[Keypoints | None] | None = None,
) -> LabelledQueries:
    """The queries of a calibration from frames of which the places are known as rows of a snapshot.

    Args:
        encodings, keypoints: as of :func:`queries_from_labels`.
        rows: for each frame the row of the place that it shows; None if the map lacks the place.
        own: for each frame the row that it is itself; None: none is.
    """
    near = _SamePlace(map_, snapshot)
    nothing = np.zeros(snapshot.rows, np.bool_)
    itself = [None] * len(rows) if own is None else own
    found = [None] * len(rows) if keypoints is None else keypoints

    def made() -> Iterator[LabelledQuery]:
        for encoding, row, own_row, points in zip(encodings, rows, itself, found, strict=True):
            if row is None:
                yield LabelledQuery(encoding.descriptor, encoding.local, nothing, nothing, nothing, points)
                continue
            absent = nothing
            if own_row is not None and own_row < snapshot.rows:
                absent = nothing.copy()
                absent[own_row] = True
            same, around = near(row) & ~absent, near(row, GUARD_FACTOR)
            yield LabelledQuery(encoding.descriptor, encoding.local, same, absent, around, points)

    return LabelledQueries(len(encodings), made())


def queries_from_traverse(
    map_: Map, snapshot: Snapshot, sequence: str, pairs: Mapping[str, str | None] | None, most: int
) -> LabelledQueries:
    """The queries of a calibration from a second traverse: the frames of one sequence, searched for in all others.

    Args:
        pairs: for places of the sequence the id of a place of another sequence that shows the same, or None if there
            is none; without ``pairs`` the poses decide which places are the same, and alignment where there are none.
        most: the largest number of queries; they are spread evenly over the sequence.

    Raises:
        UnknownSequence, UnknownPlace: the map has no sequence of this name, or no place of one of the ids.
        CalibrationImpossible: the frames have neither poses nor counterparts, and ``pairs`` is None.
    """
    members = _members(map_, sequence)
    queried = members if pairs is None else list(pairs)
    if strangers := sorted(set(queried) - set(members)):
        raise UnknownPlace(f"The sequence {sequence[:128]!r} has no place {strangers[0][:128]!r}.")
    rows = _rows_of(map_, snapshot, members + [place for place in (pairs or {}).values() if place is not None])
    own = snapshot.whereabouts.of_views(np.array([rows[place] for place in members], np.int64))  # with their looks
    near = _SamePlace(map_, snapshot)
    if pairs is None:
        others = snapshot.alive & ~own
        queried = [place for place in queried if near.has_pose(rows[place]) or (near(rows[place]) & others).any()]
        if not queried:
            raise CalibrationImpossible(
                f"The frames of the sequence {sequence[:128]!r} have no poses: align the sequence with another one, or "
                "state in pairs which places they show."
            )
    queried = spread(queried, most)
    nothing = np.zeros(snapshot.rows, np.bool_)

    def made() -> Iterator[LabelledQuery]:
        for place in queried:
            row = rows[place]
            partner = row if pairs is None else (None if (shown := pairs[place]) is None else rows[shown])
            true = nothing if partner is None else near(partner) & ~own
            around = nothing if partner is None else near(partner, GUARD_FACTOR)
            yield LabelledQuery(*_stored(snapshot, row), true, own, around, _keypoints(map_, row))

    aligned = 0 if pairs is not None else sum(not near.has_pose(rows[place]) for place in queried)
    return LabelledQueries(len(queried), made(), snapshot.alive & ~own, aligned)


def queries_from_map(map_: Map, snapshot: Snapshot, most: int) -> LabelledQueries:
    """The queries of a calibration from the map itself: its own frames, each searched for among the others.

    The neighbours in the inner half of the same-place distance are left out, if there are farther ones: the very next
    frame would be too easy to recognize.

    Args:
        most: the largest number of queries; they are spread evenly over the map.
    """
    near = _SamePlace(map_, snapshot)
    queried = spread(np.flatnonzero(snapshot.alive).tolist(), most)

    def made() -> Iterator[LabelledQuery]:
        for row in queried:
            same, itself = near(row), np.zeros(snapshot.rows, np.bool_)
            itself[row] = True
            inner = near(row, 0.5)
            absent = inner if (same & ~inner).any() else itself
            around = near(row, GUARD_FACTOR)
            yield LabelledQuery(*_stored(snapshot, row), same & ~absent, absent, around, _keypoints(map_, row))

    return LabelledQueries(len(queried), made())


def run_trials(
    map_: Map,
    encoder: Encoder,
    snapshot: Snapshot,
    queries: LabelledQueries,
    base: Calibration,
    advance: ProgressCallback,
    without_place: int = 1,
) -> StagedTrials:
    """The answers to all queries, with their places in the map and without them.

    Those of which keypoints are known are verified, too.

    Args:
        base: the calibration by which the answers are judged.
        without_place: every so manieth query is one of the map without its place, too; 0: none.

    Raises:
        StorageFailure: the map's files cannot be read.
        Others: what ``advance`` raises.
    """
    two: list[Trial] = []
    three: list[Trial] = []
    number = 0
    while batch := list(islice(queries.made, TOGETHER)):
        descriptors = np.stack([query.descriptor for query in batch])
        living = snapshot.alive if queries.allowed is None else snapshot.alive & queries.allowed
        places = int(np.count_nonzero(living))
        for query, ranking in zip(batch, snapshot.among(living).search(descriptors), strict=True):
            there = query.true & snapshot.alive & ~query.absent
            cases = [query.absent]
            if without_place and number % without_place == 0 and there.any():
                cases.append(query.absent | query.around)
            for left_out in cases:
                allowed = living & ~left_out
                scope = snapshot.among(allowed)
                if len(ranking[0]) < places and left_out[ranking[0]].any():  # a shortlist, others take their places
                    (ranking,) = scope.search(query.descriptor[np.newaxis])
                retained = allowed[ranking[0]]
                known = bool((there & ~left_out).any())
                tried = _trial(
                    map_, encoder, scope, query, (ranking[0][retained], ranking[1][retained]), base, known, number
                )
                if tried is not None:
                    two.append(tried[0])
                    three.append(tried[1])
            number += 1
            advance(number, queries.count)
    return StagedTrials(gathered(two), gathered(three))


def calibrate_map(
    map_: Map,
    encoder: Encoder,
    snapshot: Snapshot,
    queries: LabelledQueries,
    target: Target,
    source: str,
    advance: ProgressCallback = lambda _done, _total: None,
    beside: LabelledQueries | None = None,
) -> FittedCalibration:
    """A calibration of a map from its answers to queries; nothing is stored.

    Args:
        beside: further queries with answers that count as much; None: none.
        target: the target of the calibration, such as a precision.
        source: is noted in the calibration.

    Raises:
        CalibrationImpossible: the answers do not allow one.
        StorageFailure: the map's files cannot be read.
        Others: what ``advance`` raises.
    """
    base = encoder.calibration.model_copy(update={"decision": "leading"})
    sets = [queries] if beside is None else [beside, queries]
    done, total = 0, sum(one.count for one in sets)
    staged = []
    for one in sets:
        before = done

        def advanced(count: int, _of: int, before: int = before) -> None:
            advance(before + count, total)

        staged.append(run_trials(map_, encoder, snapshot, one, base, advanced))
        done += one.count
    return fit_map_calibration(joined_stages(staged), base, target, source)


def adjust_to_labels(
    map_: Map,
    encoder: Encoder,
    snapshot: Snapshot,
    queries: LabelledQueries,
    source: str,
    advance: ProgressCallback = lambda _done, _total: None,
) -> tuple[FittedCalibration, StagedTrials]:
    """The encoder's calibration, adjusted to a map's answers to labelled queries; nothing is stored.

    Labels of one kind move the map's own one, where it has one (:func:`core.judgement.calibration.adjust_calibration`).
    With labels of both kinds, some strangers are drawn from the map as well (``DRAWN``): those that were labelled may
    resemble nothing in it.

    Returns:
        The calibration, and the answers to further strangers that are drawn from the map.  None of them has a part in
        it.

    Raises:
        CalibrationImpossible: there are too few.
        StorageFailure: the map's files cannot be read.
        Others: what ``advance`` raises.
    """
    base = encoder.calibration
    trials = run_trials(map_, encoder, snapshot, queries, base, advance)
    two = trials.two
    drawn = ~two.known & np.isin(two.frame, two.frame[two.known])
    beside = drawn & ~(Kinds.of(two.take(~drawn)).enough & (two.frame % DRAWN == 0))
    asked = trials.take(~beside).answered(base)
    found = adjust_calibration(asked, base, source, present=calibration_of(map_, encoder))
    return found, trials.take(beside)


def one_sided(kinds: Kinds) -> str | None:
    """A sentence on frames of which too few are of one kind for a calibration to rest on them; None: enough."""
    if kinds.enough:
        return None
    known, strangers = kinds
    what = "strangers" if strangers < known else "places of the map"
    return (
        f"It rests on {known} frames of places of the map and {strangers} of strangers: these tell nothing of {what}. "
        f"At least {FEWEST_OF_A_KIND} of each are needed."
    )


def calibration_warnings(found: FittedCalibration, method: str, target: Target | None, aligned: int = 0) -> list[str]:
    """Sentences that the owner of a map should read about its calibration.

    Args:
        target: of the threshold; None: it had none.
        aligned: as in :class:`LabelledQueries`.
    """
    warned = {"map": FROM_ITSELF, "labels": FROM_DOUBT, "runs": FROM_RUNS}
    warnings = [warned[method]] if method in warned else []
    if (lopsided := one_sided(Kinds.of(found.trials))) is not None:
        warnings.append(f"{lopsided} The curve that was in force stays, or falls, and no answer becomes likelier.")
    if aligned:
        warnings.append(
            f"Which place {aligned} of the frames show is known from an alignment alone, not from poses of their own: "
            "where it errs, these figures err with it."
        )
    if found.measurement.frames < FEW_FRAMES:
        warnings.append(f"It rests on {found.measurement.frames} frames; {FEW_FRAMES} or more make it steadier.")
    held = found.measurement.cross_validated
    if not held.precision.of:
        warnings.append(
            "No answer of the cross-validation was recognized: the threshold is out of reach for most frames."
        )
    elif held.recall.value is not None and held.recall.value < 0.25:
        warnings.append(
            f"Only {held.recall.value:.0%} of the frames whose place is known are recognized at this target."
        )
    wanted = target.value if target is not None and target.rule == "precision" else None
    if wanted is not None and held.precision.value is not None and held.precision.high < wanted:
        warnings.append(
            f"Only {held.precision.value:.0%} of the answers that the cross-validation recognized are right, from "
            f"{held.precision.low:.0%} to {held.precision.high:.0%} in the long run: less than the {wanted:.0%} of the "
            "target."
        )
    return warnings


class _SamePlace:
    """The rows that are the same place as a row, within a multiple of the map's same-place distance; bool [rows].

    Poses count that are the places' own.
    """

    def __init__(self, map_: Map, snapshot: Snapshot) -> None:
        self._neighborhood = neighborhood_of(map_)
        self._whereabouts = own_poses(map_.counterparts, snapshot.whereabouts)

    def __call__(self, row: int, times: float = 1) -> Flags:
        return self._whereabouts.near(row, self._neighborhood.times(times))

    def has_pose(self, row: int) -> bool:
        """Whether the place has a pose of its own."""
        return bool(self._whereabouts.kind[row] != NO_POSE)


def _trial(
    map_: Map,
    encoder: Encoder,
    scope: Scope,
    query: LabelledQuery,
    ranking: Ranking,
    base: Calibration,
    known: bool,
    number: int,
) -> tuple[Trial, Trial] | None:
    """The answers to one query by two stages and by three, in the map of the places of ``scope``, by their ranking.

    None if that map is empty.
    """
    if not len(ranking[0]):
        return None

    def judged(candidates: Candidates) -> Judgement:
        return judge(
            candidates.ordered,
            candidates.whereabouts,
            base,
            neighborhood_of(map_),
            candidates.examined,
            None,
            candidates.geometry,
        )

    def tried(candidates: Candidates, judgement: Judgement) -> Trial:
        return Trial(judgement, known, known and bool(query.true[candidates.rows[0]]), number)

    candidates = agree(map_, encoder, scope, query.descriptor, query.local, ranking)
    before = tried(candidates, judged(candidates))
    if (keypoints := query.keypoints) is None:
        return before, before
    verifier = Verifier("always", lambda: keypoints)
    comparison = MapComparison(map_, encoder, query.local, verifier)
    ranked, judgement, _ = verify_candidates(candidates, judged, verifier, base, comparison)
    return before, tried(ranked, judgement)


def _stored(snapshot: Snapshot, row: int) -> tuple[NDArray[np.float32], Cells]:
    rows = np.array([row], np.int64)
    return snapshot.descriptors_at(rows)[0], snapshot.locals_at(rows)[0]


def _keypoints(map_: Map, row: int) -> Keypoints | None:
    """The stored keypoints of a place; None where there are none, or the map does not verify."""
    return map_.keypoints_at([row])[0] if map_.record.verification else None


def spread(values: list[Item], most: int) -> list[Item]:
    """At most ``most`` of the values, evenly spread."""
    chosen = np.linspace(0, len(values) - 1, min(most, len(values))).round().astype(int)
    return [values[index] for index in np.unique(chosen)]


def _rows_of(map_: Map, snapshot: Snapshot, places: Sequence[str]) -> dict[str, int]:
    rows = map_.rows_of(list(places))
    # A place that was enrolled after the snapshot was taken is not in it.
    found = {place: row for place, row in zip(places, rows, strict=True) if row is not None and row < snapshot.rows}
    if missing := [place for place in places if place not in found]:
        raise UnknownPlace(f"The map has no place {missing[0][:128]!r}.")
    return found


def _members(map_: Map, sequence: str) -> list[str]:
    """The ids of the places of a sequence in the order of their enrolment."""
    wanted = PlaceFilter(sequence=sequence)
    found, cursor = map_.places(None, 1000, wanted)
    members = [place.id for place in found]
    while cursor is not None:
        found, cursor = map_.places(cursor, 1000, wanted)
        members += [place.id for place in found]
    if not members:
        raise UnknownSequence(f"The map has no sequence {sequence[:128]!r}.")
    return members
