"""A map asked what it would answer to frames whose place is known, and calibrated by what it answers; no HTTP.

Every frame is asked twice: of the map as it is, and of the map as it would be without that place, so that there are
as many unknown places as known ones.  Without it means without all that is near it, three times as far as counts as
the same place: the next frames of a walk show the same corner still.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from core.errors import CalibrationImpossible, UnknownPlace, UnknownSequence
from core.judgement.calibration import FittedCalibration, Target, fit_map_calibration
from core.judgement.trials import Trial, Trials, gathered
from core.judgement.verdict import Calibration, judge
from core.method.agreement import Cells
from core.method.encoder import Encoder, Encoding
from core.places import NO_POSE, Neighborhood
from core.recognition.stages import agree, neighborhood_of
from core.storage import Map, Ranking, Snapshot

Item = TypeVar("Item")
Flags = NDArray[np.bool_]
Advance = Callable[[int, int], None]
"""Called with the frames asked so far, and with all of them."""

GUARD = 3
"""How many times as far as the same place reaches are left out with it."""

TOGETHER = 16
"""Queries searched for at a time."""

FEW_FRAMES = 50

FROM_ITSELF = (
    "The frames are the map's own: one walk in one light. A second visit differs more, so the probabilities are too "
    "high; calibrate from a second traverse or from labelled frames as soon as there are any."
)


@dataclass(frozen=True)
class Question:
    """One frame whose place is known; masks are bool [rows] of the snapshot.

    true: what shows its place; none of it: the map lacks the place.
    absent: what is not in the map when it is asked, as the frame itself.
    around: what is left out besides, to make its place unknown.
    """

    descriptor: NDArray[np.float32]
    local: Cells
    true: Flags
    absent: Flags
    around: Flags


@dataclass(frozen=True)
class Questions:
    """What a map is asked: ``count`` questions, made one by one; ``allowed``, bool [rows], bounds the search."""

    count: int
    made: Iterator[Question]
    allowed: Flags | None = None


def labelled(map_: Map, snapshot: Snapshot, encodings: Sequence[Encoding], places: Sequence[str | None]) -> Questions:
    """Frames that somebody has labelled, each with the id of the place that it shows, None for one the map lacks.

    Raises:
        UnknownPlace: the map has no place of an id.
    """
    rows = _rows_of(map_, snapshot, [place for place in places if place is not None])
    near = _Nearness(snapshot, neighborhood_of(map_))
    nothing = np.zeros(snapshot.rows, np.bool_)

    def made() -> Iterator[Question]:
        for encoding, place in zip(encodings, places, strict=True):
            if place is None:
                yield Question(encoding.descriptor, encoding.local, nothing, nothing, nothing)
            else:
                row = rows[place]
                yield Question(encoding.descriptor, encoding.local, near(row), nothing, near(row, GUARD))

    return Questions(len(encodings), made())


def second_traverse(
    map_: Map, snapshot: Snapshot, sequence: str, pairs: Mapping[str, str | None] | None, most: int
) -> Questions:
    """The frames of one sequence of a map, asked of all the others; truth by pose, or as stated.

    Args:
        pairs: of places of the sequence to those that show the same among the others, None for one that they lack;
            without it the poses tell.
        most: frames to ask, spread evenly.

    Raises:
        UnknownSequence, UnknownPlace: the map has none of this name, or id.
        CalibrationImpossible: the frames have no poses, and no pairs are stated.
    """
    members = _members(map_, sequence)
    asked = members if pairs is None else list(pairs)
    if strangers := sorted(set(asked) - set(members)):
        raise UnknownPlace(f"The sequence {sequence[:128]!r} has no place {strangers[0][:128]!r}.")
    rows = _rows_of(map_, snapshot, members + [place for place in (pairs or {}).values() if place is not None])
    own = np.zeros(snapshot.rows, np.bool_)
    own[[rows[place] for place in members]] = True
    near = _Nearness(snapshot, neighborhood_of(map_))
    if pairs is None:
        asked = [place for place in asked if snapshot.whereabouts.kind[rows[place]] != NO_POSE]
        if not asked:
            raise CalibrationImpossible(
                f"The frames of the sequence {sequence[:128]!r} have no poses: state in pairs which places they show."
            )
    asked = _spread(asked, most)
    nothing = np.zeros(snapshot.rows, np.bool_)

    def made() -> Iterator[Question]:
        for place in asked:
            row = rows[place]
            partner = row if pairs is None else (None if (shown := pairs[place]) is None else rows[shown])
            true = nothing if partner is None else near(partner) & ~own
            around = nothing if partner is None else near(partner, GUARD)
            yield Question(*_stored(snapshot, row), true, own, around)

    return Questions(len(asked), made(), snapshot.alive & ~own)


def map_itself(map_: Map, snapshot: Snapshot, most: int) -> Questions:
    """The map's own frames, each asked of the others.

    A frame's place counts as known by its farther neighbours only, those in the outer half of what is the same place,
    where there are any: the very next frame is too easy.
    """
    near = _Nearness(snapshot, neighborhood_of(map_))
    asked = _spread(np.flatnonzero(snapshot.alive).tolist(), most)

    def made() -> Iterator[Question]:
        for row in asked:
            same, itself = near(row), np.zeros(snapshot.rows, np.bool_)
            itself[row] = True
            inner = near(row, 0.5)
            absent = inner if (same & ~inner).any() else itself
            yield Question(*_stored(snapshot, row), same & ~absent, absent, near(row, GUARD))

    return Questions(len(asked), made())


def ask(
    map_: Map, encoder: Encoder, snapshot: Snapshot, questions: Questions, base: Calibration, advance: Advance
) -> Trials:
    """The answers to all questions, with each place in the map and without it.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    found: list[Trial] = []
    number = 0
    while several := list(islice(questions.made, TOGETHER)):
        descriptors = np.stack([question.descriptor for question in several])
        for question, ranking in zip(several, snapshot.search_batch(descriptors, questions.allowed), strict=True):
            there = question.true & snapshot.alive & ~question.absent
            cases = [question.absent] if not there.any() else [question.absent, question.absent | question.around]
            for left_out in cases:
                known = bool((there & ~left_out).any())
                found += _trial(map_, encoder, snapshot, question, ranking, left_out, base, known, number)
            number += 1
            advance(number, questions.count)
    return gathered(found)


def calibrated(
    map_: Map,
    encoder: Encoder,
    snapshot: Snapshot,
    questions: Questions,
    target: Target,
    source: str,
    advance: Advance = lambda _done, _total: None,
) -> FittedCalibration:
    """A calibration of a map by what it answers to questions; nothing is stored.

    Raises:
        CalibrationImpossible: the answers do not tell when to believe them.
        StorageFailure: the map's files cannot be read.
    """
    base = encoder.calibration.model_copy(update={"decision": "leading"})
    return fit_map_calibration(ask(map_, encoder, snapshot, questions, base, advance), base, target, source)


def warnings_on(found: FittedCalibration, method: str) -> list[str]:
    """What the owner of a map should know of its calibration."""
    told = [FROM_ITSELF] if method == "map" else []
    if found.measurement.frames < FEW_FRAMES:
        told.append(f"It rests on {found.measurement.frames} frames; {FEW_FRAMES} or more make it steadier.")
    held = found.measurement.cross_validated
    if not held.precision.of:
        told.append("No answer of the cross-validation was recognized: the threshold is out of reach for most frames.")
    elif held.recall.value is not None and held.recall.value < 0.25:
        told.append(f"Only {held.recall.value:.0%} of the frames whose place is known are recognized at this target.")
    return told


class _Nearness:
    """What is the same place as a row, farther or nearer than the map says; bool [rows]."""

    def __init__(self, snapshot: Snapshot, neighborhood: Neighborhood) -> None:
        self._whereabouts, self._neighborhood = snapshot.whereabouts, neighborhood

    def __call__(self, row: int, times: float = 1) -> Flags:
        reach = Neighborhood(self._neighborhood.radius * times, int(self._neighborhood.frames * times))
        return self._whereabouts.near(row, reach)


def _trial(
    map_: Map,
    encoder: Encoder,
    snapshot: Snapshot,
    question: Question,
    ranking: Ranking,
    left_out: Flags,
    base: Calibration,
    known: bool,
    number: int,
) -> list[Trial]:
    """One question to the map without some rows; nothing if no place is left."""
    kept = ~left_out[ranking[0]]
    remaining: Ranking = ranking[0][kept], ranking[1][kept]
    if not len(remaining[0]):
        return []
    candidates = agree(map_, encoder, snapshot, question.local, remaining)
    judgement = judge(candidates.ordered, candidates.whereabouts, base, neighborhood_of(map_), candidates.examined)
    return [Trial(judgement, known, known and bool(question.true[candidates.rows[0]]), number)]


def _stored(snapshot: Snapshot, row: int) -> tuple[NDArray[np.float32], Cells]:
    rows = np.array([row], np.int64)
    return snapshot.descriptors_at(rows)[0], snapshot.locals_at(rows)[0]


def _spread(values: list[Item], most: int) -> list[Item]:
    """At most so many of them, evenly spread."""
    chosen = np.linspace(0, len(values) - 1, min(most, len(values))).round().astype(int)
    return [values[index] for index in np.unique(chosen)]


def _rows_of(map_: Map, snapshot: Snapshot, places: Sequence[str]) -> dict[str, int]:
    rows = map_.rows_of(list(places))
    # One that was enrolled since is not in the snapshot.
    found = {place: row for place, row in zip(places, rows, strict=True) if row is not None and row < snapshot.rows}
    if missing := [place for place in places if place not in found]:
        raise UnknownPlace(f"The map has no place {missing[0][:128]!r}.")
    return found


def _members(map_: Map, sequence: str) -> list[str]:
    """The ids of the places of a sequence in the order of their enrolment."""
    found, cursor = map_.places(None, 1000, sequence)
    members = [place.id for place in found]
    while cursor is not None:
        found, cursor = map_.places(cursor, 1000, sequence)
        members += [place.id for place in found]
    if not members:
        raise UnknownSequence(f"The map has no sequence {sequence[:128]!r}.")
    return members
