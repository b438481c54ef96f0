"""The job that aligns a traverse with others: which of its frames show the places of another.

Descriptors as they are stored are compared, by inner products; nothing is encoded.  The result is stored in one
commit, for the places that are then still as they were compared; so an attempt that was cancelled or killed has stored
nothing, or everything, and the next attempt begins again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownSequence
from core.judgement.alignment import LARGEST_STEP, LEAST_FRAMES, shared_stretches
from core.maps import Correspondence
from core.maps.records import Outline
from core.places import NO_POSE
from core.recognition.stages import neighborhood_of
from core.store import Map, Snapshot
from core.upkeep.correspondence import common_stations, handed_over, on_its_own
from service.engine.engine import Engine
from service.errors.faults import InvalidRequest, TooFewFrames
from service.errors.problems import problem_of
from service.jobs.context import JobContext, yield_to_requests
from service.maps.self_calibration import calibrate_by_traverse
from service.queries.statistics import QueryStatistics

KIND = "align"

MOST_LISTED = 200
"""How many stretches the report lists at most; all are counted and stored."""

Rows = NDArray[np.int64]


def align(engine: Engine, statistics: QueryStatistics, context: JobContext) -> Mapping[str, Any]:
    """Find what the traverse shares with others, and store it unless ``dry_run`` is set; the map then calibrates itself
    by it.

    Raises:
        UnknownMap, UnknownSequence, TooFewFrames, UnknownPlace, StorageFull, StorageFailure: the map is what it was.
        JobCancelled, JobInterrupted.
    """
    options = context.arguments
    told = align_sequence(engine, context, options["sequence"], options["with"], options["poses"], options["dry_run"])
    return _calibrated(engine, statistics, context, told)


def align_sequence(
    engine: Engine,
    context: JobContext,
    sequence: str,
    others: Sequence[str] | None = None,
    poses: bool = True,
    dry_run: bool = False,
) -> dict[str, Any]:
    """Align one traverse of the job's map, and report.

    Args:
        others: the names of the traverses to align it with; None: all others that have enough frames; none: what is
            stored of the traverse's counterparts is forgotten.
        poses: whether frames without a pose get that of their counterpart.
        dry_run: whether to report only.

    Raises:
        As :func:`align`.
    """
    map_ = context.map(engine.maps)
    traverses = TraversesToAlign(map_)
    first = traverses.rows(sequence)
    names = traverses.others(sequence) if others is None else list(dict.fromkeys(others))
    seconds = [traverses.rows(name) for name in names]
    total, done = sum(len(first) * len(second) for second in seconds), 0

    def advance(pairs: int) -> None:
        nonlocal done
        done += pairs
        context.progress(done, total, "comparing frames")
        yield_to_requests(engine, context)

    yield_to_requests(engine, context)
    found = [
        _shared(traverses.snapshot, name, first, second, advance) for name, second in zip(names, seconds, strict=True)
    ]
    context.progress(total, total, "storing what corresponds")
    with engine.writing(map_.record.id), map_.transfer.paused_writes():
        change = _change(map_, traverses, first, found, others is not None and not others, poses)
        context.check_cancelled()
        if not dry_run:
            map_.counterparts.store(change)
    return _report(traverses, sequence, first, found, change) | {"compared": total, "stored": not dry_run}


def align_enrolled(
    statistics: QueryStatistics, engine: Engine, context: JobContext, sequences: Sequence[str]
) -> list[dict[str, Any]]:
    """Align traverses that the job has enrolled with all others of its map; a report for each.

    Instead of the report of a traverse that is too short, or gone by now, there is the problem.  By the traverse that
    shares most the map then calibrates itself.

    Raises:
        As :func:`align`, without UnknownSequence and TooFewFrames.
    """
    reports: list[dict[str, Any]] = []
    for sequence in sequences:
        try:
            reports.append(align_sequence(engine, context, sequence))
        except (UnknownSequence, TooFewFrames) as error:
            reports.append({"sequence": sequence, "problem": problem_of(error).model_dump(exclude_none=True)})
    most = max(range(len(reports)), key=lambda number: reports[number].get("paired", 0), default=None)
    if most is not None:
        reports[most] = _calibrated(engine, statistics, context, reports[most])
    return reports


def _calibrated(
    engine: Engine, statistics: QueryStatistics, context: JobContext, told: dict[str, Any]
) -> dict[str, Any]:
    """The report of a traverse, with what became of the calibration if something that it shares was stored."""
    if not told.get("paired") or not told["stored"]:
        return told
    found = calibrate_by_traverse(engine, statistics, context, told["sequence"])
    return told if found is None else told | {"calibration": found}


def check_request(map_: Map, sequence: str, others: Sequence[str] | None) -> None:
    """Check that a map has the traverses of a request, each with enough frames.

    Raises:
        UnknownSequence, TooFewFrames, InvalidRequest.
    """
    if sequence in (others or ()):
        raise InvalidRequest("with: a sequence cannot be aligned with itself.")
    traverses = TraversesToAlign(map_)
    for name in (sequence, *(others or ())):
        traverses.rows(name)


class TraversesToAlign:
    """The traverses of a map at one moment, with at least one frame each.

    snapshot: the searched places at that moment.
    whereabouts: of its rows.
    places: the places by their rows.
    """

    def __init__(self, map_: Map) -> None:
        outline = map_.transfer.outline()
        self.snapshot = map_.snapshot()
        self.whereabouts = self.snapshot.whereabouts  # of now: some stores read them only when they are needed
        # A place that is being stored at this moment is listed before its row is in a snapshot.
        self.places = {place.row: place for place in outline if place.row < self.snapshot.rows}
        self._members: dict[str, list[Outline]] = {}
        for place in self.places.values():
            if place.sequence is not None:
                self._members.setdefault(place.sequence, []).append(place)

    def others(self, sequence: str) -> list[str]:
        """All other traverses that have enough frames, in the order of their first places."""
        return [name for name in self._members if name != sequence and len(self._members[name]) >= LEAST_FRAMES]

    def rows(self, name: str) -> Rows:
        """The rows of a traverse's frames in their order, int64.

        Raises:
            UnknownSequence: there is none.
            TooFewFrames: it has too few frames for sequence matching.
        """
        frames = self.frames(name)
        if len(frames) < LEAST_FRAMES:
            raise TooFewFrames(
                f"The sequence {name[:128]!r} has {len(frames)} frames; to align it takes at least {LEAST_FRAMES}."
            )
        return frames

    def frames(self, name: str) -> Rows:
        """The same of a traverse of any length.

        Raises:
            UnknownSequence: there is none.
        """
        members = self._members.get(name, [])
        if not members:
            raise UnknownSequence(f"The map has no sequence {name[:128]!r}.")
        return np.array([place.row for place in sorted(members, key=lambda one: one.ordinal)], np.int64)


@dataclass(frozen=True)
class Shared:
    """The stretches that the aligned traverse shares with another one.

    name: of the other.
    rows: int64 [r], of its frames.
    stretches: each as rows of the map, int64 [n, 2], of the aligned traverse and of the other; the surest first.
    totals: how much speaks for each stretch.
    """

    name: str
    rows: Rows
    stretches: Sequence[Rows]
    totals: Sequence[float]


def _shared(snapshot: Snapshot, name: str, first: Rows, second: Rows, advance: Callable[[int], None]) -> Shared:
    """Compare two traverses by the inner products of their descriptors.

    If the other one has too many frames for a path to keep up with it, its frames are matched with those
    of the first.
    """
    turned = len(second) > LARGEST_STEP * len(first)
    along, beside = (second, first) if turned else (first, second)

    def scores(frames: Rows) -> Callable[[Rows], NDArray[np.float32]]:
        queries = snapshot.descriptors_at(along[frames])
        return lambda others: queries @ snapshot.descriptors_at(beside[others]).T

    found = shared_stretches(scores, len(along), len(beside), advance)
    stretches = [np.stack([along[one.first], beside[one.second]], axis=1) for one in found]
    stretches = [pairs[:, ::-1] for pairs in stretches] if turned else stretches
    return Shared(name, second, stretches, [one.total for one in found])


def _pairs(found: Sequence[Shared], still: NDArray[np.bool_]) -> Rows:
    """The rows of all pairs of frames of which both are ``still`` there, bool [rows]; those of the surest first."""
    stretches = [(total, rows) for one in found for total, rows in zip(one.totals, one.stretches, strict=True)]
    stretches.sort(key=lambda one: -one[0])
    pairs = np.concatenate([np.empty((0, 2), np.int64), *(rows for _, rows in stretches)])
    return pairs[still[pairs].all(axis=1)]


def _change(
    map_: Map, traverses: TraversesToAlign, own: Rows, found: Sequence[Shared], forget: bool, poses: bool
) -> Correspondence:
    """The changes for the places that are unchanged since they were compared; call it while no write begins.

    The result of an earlier alignment of these traverses gives way, unless nothing was found in its place.

    Args:
        own: the rows of the aligned traverse.
        forget: whether all that is stored of its counterparts is forgotten.
    """
    then, snapshot = traverses.snapshot, map_.snapshot()
    before = traverses.whereabouts
    still = snapshot.alive[: then.rows].copy()
    for name in ("sequence", "ordinal"):
        still &= getattr(snapshot.whereabouts, name)[: then.rows] == getattr(before, name)
    pairs = _pairs(found, still)
    pairs = pairs[~before.on_other_levels(pairs[:, 0], pairs[:, 1], neighborhood_of(map_).height)]
    if not len(pairs) and not forget:
        return Correspondence()
    rows = np.flatnonzero(snapshot.alive)
    places = snapshot.whereabouts_at(rows)
    at = np.full(snapshot.rows, -1)
    at[rows] = np.arange(len(rows))
    code = before.sequence[own[0]]
    mine = places.sequence == code
    theirs = ~mine if forget else np.isin(places.sequence, [before.sequence[one.rows[0]] for one in found])
    released = np.where(mine, places.track != code, theirs & (places.track == code))
    track, station = common_stations(*on_its_own(places, released), at[pairs])
    moved = np.flatnonzero((track != places.track) | (station != places.station))
    stations = {int(rows[i]): (int(track[i]), int(station[i])) for i in moved}

    ids = {traverses.places[row].id for row in own.tolist()}
    handed: dict[int, int | None] = {
        row: None
        for row, giver in map_.counterparts.handed_over().items()
        if mine[at[row]] or (theirs[at[row]] and giver in ids)
    }
    kind = places.kind.copy()
    kind[at[list(handed)]] = NO_POSE
    given = rows[handed_over(kind, at[pairs])].tolist() if poses else []
    return Correspondence(stations, handed | dict(given))


def _report(
    traverses: TraversesToAlign, sequence: str, own: Rows, found: Sequence[Shared], change: Correspondence
) -> dict[str, Any]:
    places = traverses.places
    frames = set(own.tolist())
    given = [(receiver, giver) for receiver, giver in change.poses.items() if giver is not None]
    room, listed = MOST_LISTED, []
    for one in found:
        theirs = set(one.rows.tolist())
        stretches = [
            {
                "frames": len(rows),
                "first": places[int(rows[0, 0])].id,
                "last": places[int(rows[-1, 0])].id,
                "with_first": places[int(rows[0, 1])].id,
                "with_last": places[int(rows[-1, 1])].id,
                "gain": total / len(rows),
            }
            for rows, total in zip(one.stretches[:room], one.totals, strict=False)
        ]
        room -= len(stretches)
        listed.append({
            "sequence": one.name,
            "frames": len(one.rows),
            "paired": sum(len(rows) for rows in one.stretches),
            "stretch_count": len(one.stretches),
            "stretches": stretches,
            "poses": {
                "received": sum(receiver in frames and giver in theirs for receiver, giver in given),
                "given": sum(receiver in theirs for receiver, _ in given),
            },
        })  # fmt: skip
    paired = np.unique(
        np.concatenate([np.empty(0, np.int64), *(rows[:, 0] for one in found for rows in one.stretches)])
    )
    return {
        "sequence": sequence,
        "frames": len(own),
        "paired": len(paired),
        "traverses": listed,
        "stations_changed": len(change.stations),
        "poses_handed_over": len(given),
        "poses_taken_back": len(change.poses) - len(given),
    }
