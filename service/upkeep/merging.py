"""The job that merges maps: it copies the places of one map into another of the same encoder, without encoding them.

Each commit copies some places with everything that is stored of them.  After a restart the job continues with the
places that are missing; if it fails or is cancelled, it removes those that it copied.  They are known by their numbers,
which are higher than the last number that the map had when the merge began.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from core.errors import (
    InvalidIdentifier,
    MixedCoordinates,
    PlacerecError,
    StorageFailure,
    UnknownCamera,
    UnknownMap,
    WrongEncoder,
)
from core.maps import Enrolment, History
from core.maps.records import Outline
from core.method.encoder import Encoding
from core.method.regions import Regions
from core.places import PoseKind, check_coordinates, check_place_id, look_address, place_and_look, pose_kinds
from core.recognition.question import Query, Question
from core.recognition.recognition import locate
from core.recognition.self_queries import TOGETHER, spread_order
from core.store import Map, Snapshot
from service.engine.engine import Engine
from service.errors.faults import MergeConflict
from service.jobs.context import JobContext, JobInterrupted, yield_to_requests
from service.places.place_events import tell_change

KIND = "merge"

PLACES_PER_COMMIT = 64

MOST_LISTED = 20
"""How many ids, names or pairs a report or message lists at most."""

ROUNDS = 3
"""How often the job looks for places that changed in the other map while it copied."""


@dataclass(frozen=True)
class MergePlan:
    """The steps of a merge.

    coming: the places and looks of the other map that are copied, each with its id in this map.
    known: how many places this map has already, with the same frame.
    frames: the digests of the frames of the places that are in both maps, or will be, by their ids in this map.
    skipped: ids of places that are not copied, because the id belongs to another frame here.
    renamed: how many places get another id.
    sequences, cameras: the new names of sequences and cameras of the other map, by their names there.
    conflicts: sentences that say why the maps cannot be merged; empty if they can.
    """

    coming: Sequence[tuple[Outline, str]]
    known: int
    frames: Mapping[str, bytes]
    skipped: Sequence[str]
    renamed: int
    sequences: Mapping[str, str]
    cameras: Mapping[str, str]
    conflicts: Sequence[str]

    @property
    def places(self) -> int:
        """How many places are copied, their looks apart."""
        return sum(not one.is_look for one, _ in self.coming)

    def report(self) -> dict[str, Any]:
        """The plan as JSON, for the result of the job."""
        return {
            "coming": self.places,
            "looks": len(self.coming) - self.places,
            "known": self.known,
            "skipped": {"count": len(self.skipped), "places": list(self.skipped[:MOST_LISTED])},
            "renamed": {"places": self.renamed, "sequences": dict(self.sequences), "cameras": dict(self.cameras)},
            "conflicts": list(self.conflicts),
        }


def poses_apart(map_: Map, other: Map) -> MixedCoordinates | None:
    """Why the places of a map cannot be copied into another one: their coordinates are of the kind that it has not.

    Raises:
        StorageFailure.
    """
    ours, theirs = _kinds(map_), _kinds(other)
    try:
        for kind in theirs:
            check_coordinates(ours, kind, f"The map {other.record.id!r}")
    except MixedCoordinates as error:
        return error
    return None


def _kinds(map_: Map) -> set[PoseKind]:
    """The kinds of the poses of a map."""
    snapshot = map_.snapshot()
    return pose_kinds(snapshot.whereabouts_at(np.flatnonzero(snapshot.alive)).kind)


def check_same_encoder(map_: Map, other: Map) -> None:
    """Check that two maps have the same encoder.

    Raises:
        WrongEncoder: they have not.
    """
    ours, theirs = map_.record.encoder, other.record.encoder
    if ours != theirs:
        raise WrongEncoder(
            f"The map {other.record.id} is bound to {theirs}, {map_.record.id} to {ours}; re-encode one of them first."
        )


def plan_merge(map_: Map, other: Map, options: Mapping[str, Any], before: Sequence[Outline]) -> MergePlan:
    """Decide what to copy, under which names, and find what prevents it; nothing is changed.

    Args:
        options: ``on_conflict`` and ``prefix`` of the request.
        before: the places that this map had when the merge began.
    """
    rule, prefix = options["on_conflict"], options["prefix"]
    here = {place.id: place for place in before}
    coming: list[tuple[Outline, str]] = []
    skipped, conflicts, known, renamed = [], [], 0, 0
    clashing: list[str] = []
    unnamed: list[Outline] = []  # places that should be copied, but have no free id
    frames: dict[str, bytes] = {}
    called: dict[str, str] = {}  # the ids here of the places that are, or will be, in both maps
    for place in other.transfer.outline(looks=True):
        if place.is_look:
            of, look = place_and_look(place.id)
            if of in called and look is not None and (name := look_address(called[of], look)) not in here:
                coming.append((place, name))
            continue
        called[place.id] = place.id
        present = here.get(place.id)
        if present is not None and present.digest == place.digest:
            known += 1
        elif present is None:
            coming.append((place, place.id))
        elif rule == "skip":
            skipped.append(place.id)
            del called[place.id]
        elif rule == "rename":
            name = called[place.id] = prefix + place.id
            if (present := here.get(name)) is not None and present.digest == place.digest:
                known += 1
            elif present is not None or not _can_name_a_place(name):
                clashing.append(name)
                unnamed.append(place)
            else:
                renamed += 1
                coming.append((place, name))
        else:
            clashing.append(place.id)
            unnamed.append(place)
        if place.id in called:
            frames[called[place.id]] = place.digest
    if clashing:
        conflicts.append(f"{len(clashing)} ids belong to other frames here: {_listed(clashing)}.")
    given = {name for _, name in coming}
    if len(given) < len(coming):
        conflicts.append(f"{len(coming) - len(given)} places would get the id of another place; choose another prefix.")
    wanted = [place for place, _ in coming] + unnamed
    sequences, cameras = _new_names(map_, other, options, before, wanted, conflicts)
    return MergePlan(coming, known, frames, skipped, renamed, sequences, cameras, conflicts)


def _new_names(
    map_: Map,
    other: Map,
    options: Mapping[str, Any],
    before: Sequence[Outline],
    coming: Sequence[Outline],
    conflicts: list[str],
) -> tuple[dict[str, str], dict[str, str]]:
    """New names for sequences and cameras whose names are taken here; others are added to conflicts."""
    rule, prefix = options["on_conflict"], options["prefix"]
    ours = {place.sequence for place in before}
    theirs = {place.sequence for place in coming if not place.is_look}
    shared = sorted(name for name in theirs & ours if name is not None)
    sequences = {name: prefix + name for name in shared} if rule == "rename" else {}
    if shared and rule == "refuse":
        conflicts.append(f"Both maps have the sequences {_listed(shared)}.")
    if taken := [name for name in sequences.values() if name in ours or len(name) > 128]:
        conflicts.append(f"The names {_listed(taken)} of sequences are taken or too long; choose another prefix.")
    stored = {camera.name: camera.settings() for camera in map_.cameras.all()}
    used = {place.camera for place in coming}
    known = [camera for camera in other.cameras.all() if camera.name in used and camera.name in stored]
    unlike = [camera for camera in known if stored[camera.name] != camera.settings()]
    cameras = {camera.name: prefix + camera.name for camera in unlike} if rule == "rename" else {}
    if unlike and rule != "rename":
        conflicts.append(
            f"The cameras {_listed([camera.name for camera in unlike])} have other masks, intrinsics or values here."
        )
    if taken := [
        new for name, new in cameras.items() if len(new) > 64 or stored.get(new, (None, None)) != (None, None)
    ]:
        conflicts.append(f"The names {_listed(taken)} of cameras are taken or too long; choose another prefix.")
    return sequences, cameras


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST_LISTED])


def _can_name_a_place(name: str) -> bool:
    try:
        check_place_id(name)
    except InvalidIdentifier:
        return False
    return True


def merge(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Merge, or continue to merge, the map that the job's argument ``from`` names into the job's map.

    The other arguments are ``on_conflict``, ``prefix``, ``dry_run`` and ``sample`` of the request.

    Raises:
        UnknownMap, WrongEncoder, MixedCoordinates, MergeConflict, EncoderNotInstalled, StorageFull, StorageFailure:
            the map is what it was before.
        JobCancelled: likewise.
        JobInterrupted: the next attempt continues.
    """
    map_ = context.map(engine.maps)
    try:
        other = context.map(engine.maps, context.arguments["from"])
        check_same_encoder(map_, other)
    except PlacerecError as error:
        if "after" in context.notes:
            with engine.writing(map_.record.id):
                _remove_copies(context, map_, None, error)
        raise
    if "after" not in context.notes:
        outline = map_.transfer.outline(looks=True)
        plan = plan_merge(map_, other, context.arguments, outline)
        apart = poses_apart(map_, other)
        report = plan.report() | {
            "overlap": measure_overlap(engine, context, map_, other) if context.arguments["sample"] else None,
        }
        if context.arguments["dry_run"]:
            return report if apart is None else report | {"conflicts": [str(apart), *plan.conflicts]}
        if apart is not None:
            raise apart
        if plan.conflicts:
            raise MergeConflict(" ".join(plan.conflicts))
        after = max((place.number for place in outline), default=0)
        coming = {name: place.digest.hex() for place, name in plan.coming}
        cameras = _new_cameras(map_, other, plan)
        context.remember(after=after, report=report, cameras=cameras, coming=coming)
    try:
        refused = _copy_places(engine, context, map_, other)
    except JobInterrupted:
        raise
    except BaseException as error:
        with engine.writing(map_.record.id):
            _remove_copies(context, map_, other, error)
        raise
    tell_change(engine, map_, "created", context.notes["report"]["coming"])
    looks = context.notes["report"]["looks"] - refused
    return dict(context.notes["report"]) | {"looks": looks, "places": map_.count_places()}


def _new_cameras(map_: Map, other: Map, plan: MergePlan) -> list[str]:
    existing = {camera.name for camera in map_.cameras.all()}
    used = {place.camera for place, _ in plan.coming}
    names = [plan.cameras.get(camera.name, camera.name) for camera in other.cameras.all() if camera.name in used]
    return [name for name in names if name not in existing]


def _places_before(context: JobContext, map_: Map) -> list[Outline]:
    return [place for place in map_.transfer.outline(looks=True) if place.number <= context.notes["after"]]


def _copy_places(engine: Engine, context: JobContext, map_: Map, other: Map) -> int:
    """Copy the places that are missing, then those that changed in the other map meanwhile, and their stations.

    Returns:
        How many looks were left out, because their places are gone here, or cannot have them.
    """
    refused: set[str] = set()
    for _ in range(ROUNDS):
        context.check_cancelled()
        here = {place.id: place.digest for place in map_.transfer.outline(looks=True)}
        plan = plan_merge(map_, other, context.arguments, _places_before(context, map_))
        coming = [(place, name) for place, name in plan.coming if name in context.notes["coming"]]
        due = [(place, name) for place, name in coming if here.get(name) != place.digest and name not in refused]
        if not due:
            break
        names = context.notes["report"]["renamed"]
        for camera in other.cameras.all():
            name = names["cameras"].get(camera.name, camera.name)
            if name in context.notes["cameras"]:
                map_.cameras.put(name, *camera.settings())
        snapshot = other.snapshot()
        for first in range(0, len(due), PLACES_PER_COMMIT):
            yield_to_requests(engine, context)
            # No place may be enrolled under one of the ids between this check and the commit.
            with engine.writing(map_.record.id):
                free = _still_free(context, map_, plan, due[first : first + PLACES_PER_COMMIT], refused)
                refused.update(_copy(context, map_, other, snapshot, free))
            context.progress(len(coming) - len(due) + min(first + PLACES_PER_COMMIT, len(due)), len(coming))
    map_.counterparts.copy(other.counterparts, {place.id: name for place, name in coming})
    return len(refused)


def _still_free(
    context: JobContext, map_: Map, plan: MergePlan, due: Sequence[tuple[Outline, str]], refused: set[str]
) -> list[tuple[Outline, str]]:
    """Those of the places whose ids nobody has given to another frame since the merge began, with their looks.

    Args:
        refused: gets the looks of other places.

    Raises:
        MergeConflict: an id was given to another frame, and the request does not say to skip such places.
    """
    free: list[tuple[Outline, str]] = []
    for place, name in due:
        if place.is_look:
            of = place_and_look(name)[0]
            if map_.digest(of) in (None, plan.frames[of]):  # it may come with its place
                free.append((place, name))
            else:
                refused.add(name)
            continue
        digest = map_.digest(name)
        if digest is None or digest.hex() == context.notes["coming"][name]:
            free.append((place, name))
        elif context.arguments["on_conflict"] != "skip":
            raise MergeConflict(f"The place {name!r} was enrolled with another frame during the merge.")
    return free


def _copy(
    context: JobContext, map_: Map, other: Map, snapshot: Snapshot, due: Sequence[tuple[Outline, str]]
) -> list[str]:
    """Copy some places in one commit; nobody else may enrol meanwhile.  Returns the looks that were left out.

    The first commit that copies a place of a sequence keeps as many positions at its end here as the sequence has
    there, so that what is enrolled between the commits is at other positions.  If the job is interrupted before it has
    noted that, the rest of the sequence gets positions of its own, too.
    """
    names, ranges = context.notes["report"]["renamed"], dict(context.notes.get("ranges", {}))
    ends, theirs = map_.transfer.sequence_ends(), other.transfer.sequence_ends()
    pictures = {place.id: other.picture(place.id) for place, _ in due}
    # This is read after the pictures: if a place still has its row, its picture is that of the same frame.  Places
    # that were changed or forgotten since they were listed are left to the next round.
    found = other.transfer.find([place.id for place, _ in due])
    ready = [(p, name) for p, name in due if p.id in found and found[p.id][1] == p.row < snapshot.rows]
    rows = np.array([place.row for place, _ in ready], np.int64)
    descriptors, local = snapshot.descriptors_at(rows), snapshot.locals_at(rows)
    keypoints = other.keypoints_at([place.row for place, _ in ready])
    items = []
    for (place, name), descriptor, cells, of_frame in zip(ready, descriptors, local, keypoints, strict=True):
        stored = found[place.id][0]
        called = {
            "sequence": names["sequences"].get(stored.sequence, stored.sequence),
            "camera": names["cameras"].get(stored.camera, stored.camera),
        }
        picture = pictures[place.id]
        item = Enrolment(
            id=name,
            fields=stored.fields().model_copy(update=called),
            descriptor=descriptor,
            regions=stored.regions,
            digest=place.digest,
            local=cells,
            thumbnail=picture if stored.picture == "thumbnail" else None,
            image=picture if stored.picture == "image" else None,
            keypoints=of_frame,
            run=place.run,
            least=place.least,
        )
        if place.is_look:
            items.append((item, History(stored.picture, None, stored.created_at, stored.updated_at)))
            continue
        end = ends.get(called["sequence"], 0)
        first, behind = ranges.setdefault(called["sequence"] or "", [end, end + theirs.get(stored.sequence, 0)])
        ordinal = first + place.ordinal
        history = History(
            stored.picture, ordinal if ordinal < behind else None, stored.created_at, stored.updated_at, behind
        )
        items.append((item, history))
    refused = map_.transfer.adopt(items)
    if ranges != context.notes.get("ranges"):
        context.remember(ranges=ranges)
    return refused


def _remove_copies(context: JobContext, map_: Map, other: Map | None, error: BaseException) -> None:
    """Remove what the merge copied, so that the map is what it was before.

    Args:
        other: the map that was merged; None if it is gone.
        error: why the merge ended.

    Raises:
        StorageFailure: the disk refuses, and copied places remain.
    """
    try:
        noted = {name: {bytes.fromhex(digest)} for name, digest in context.notes["coming"].items()}
        if other is not None:
            with suppress(PlacerecError):  # if the other map is gone, its places were copied as they are noted
                for place, name in plan_merge(map_, other, context.arguments, _places_before(context, map_)).coming:
                    if name in noted:
                        noted[name].add(place.digest)
        copied = {
            place.id: place.digest
            for place in map_.transfer.outline(looks=True)
            if place.id in context.notes["coming"]
            and place.number > context.notes["after"]
            and place.digest in noted[place.id]
        }
        map_.transfer.forget(copied)
        for camera in context.notes["cameras"]:
            try:
                map_.cameras.forget(camera)
            except UnknownCamera:
                continue
    except UnknownMap:
        return  # the map was deleted, with everything that was copied
    except PlacerecError as further:
        raise StorageFailure(
            f"The merge failed ({error or type(error).__name__}), and the places that it had copied could not be "
            f"removed ({further}): places of the map {context.arguments['from']} remain; merge it again or delete them."
        ) from error


_NO_REGIONS = Regions(
    np.empty((0, 4), np.int32),
    np.empty(0, np.float32),
    np.empty(0, np.int32),
    np.empty(0, np.int32),
    np.empty((0, 0), np.float32),
)
"""Stands for the regions of a frame that is no longer available; a search does not use them."""


def measure_overlap(engine: Engine, context: JobContext, map_: Map, other: Map) -> dict[str, Any]:
    """Count how many of the other map's places this map recognizes, in a sample that is spread over the other map.

    Returns:
        JSON: counts by verdict, the median distance in metres between recognized places and their matches, and the
        pairs with the highest scores.

    Raises:
        EncoderNotInstalled, StorageFailure, JobCancelled, JobInterrupted.
    """
    encoder = engine.load_encoder(map_)
    outline, snapshot = other.transfer.outline(), other.snapshot()
    outline = [place for place in outline if place.row < snapshot.rows]  # without places that are being written now
    chosen = [outline[i] for i in spread_order(len(outline))[: context.arguments["sample"]]]
    verdicts = {"recognized": 0, "ambiguous": 0, "unknown": 0}
    pairs: list[dict[str, Any]] = []
    apart: list[float] = []
    for first in range(0, len(chosen), TOGETHER):
        yield_to_requests(engine, context)
        some = chosen[first : first + TOGETHER]
        rows = np.array([place.row for place in some], np.int64)
        descriptors, local = snapshot.descriptors_at(rows), snapshot.locals_at(rows)
        queries = [
            Query(Encoding(d, cells, _NO_REGIONS, {}), Question(k=1))
            for d, cells in zip(descriptors, local, strict=True)
        ]
        stored = other.transfer.find([place.id for place in some])
        for place, located in zip(some, locate(map_, encoder, queries), strict=True):
            verdicts[located.judgement.verdict] += 1
            if located.judgement.verdict != "recognized" or place.id not in stored:
                continue
            score, match = located.matches[0]
            pairs.append({"place": place.id, "match": match.id, "score": float(score)})
            ours, theirs = (one.pose if one.pose_of is None else None for one in (match, stored[place.id][0]))
            if ours is not None and theirs is not None and ours.kind() == theirs.kind():
                apart.append(float(np.linalg.norm(ours.position() - theirs.position())))
        context.progress(first + len(some), len(chosen), "comparing the maps")
    pairs.sort(key=lambda pair: -pair["score"])
    return {
        "examined": len(chosen),
        "of": len(outline),
        **verdicts,
        "metres_apart": median(apart) if apart else None,
        "pairs": pairs[:MOST_LISTED],
    }
