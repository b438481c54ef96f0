"""The places of one map taken into another of the same encoder, without encoding anything again.

Places come in by commits of some, each place with all that belongs to it.  After a kill the job goes on behind those
that came; if it fails or is cancelled, those are taken out again.  Which ones came with it can be told at any time:
what the map held before has a number up to the one that was noted at the beginning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from core.errors import InvalidIdentifier, PlacerecError, StorageFailure, UnknownCamera, UnknownMap, WrongEncoder
from core.method.encoder import Encoding
from core.method.regions import Regions
from core.places import PlaceFields, check_place_id
from core.recognition.recognition import locate
from core.recognition.self_queries import TOGETHER, spread_order
from core.storage import Enrolment, History, Map, Snapshot
from core.storage.transfer import Outline
from service.engine.engine import Engine
from service.errors.faults import MergeConflict
from service.jobs.context import JobContext, JobInterrupted, yield_to_requests

KIND = "merge"

CHUNK = 64
"""Places of one commit."""

NAMED = 20
ROUNDS = 3
"""Places that change in the other map while they are taken are looked at again so often."""


@dataclass(frozen=True)
class Plan:
    """What a merge does.

    coming: the other map's places that come, and the id that each gets.
    known: places that this map has already, with the same frame.
    skipped: ids that mean another frame here, whose places are left out.
    renamed: places that get another id.
    sequences, cameras: other names for those of the other map.
    conflicts: sentences that say why it cannot be done.
    """

    coming: Sequence[tuple[Outline, str]]
    known: int
    skipped: Sequence[str]
    renamed: int
    sequences: Mapping[str, str]
    cameras: Mapping[str, str]
    conflicts: Sequence[str]

    def report(self) -> dict[str, Any]:
        """As callers see it."""
        return {
            "coming": len(self.coming),
            "known": self.known,
            "skipped": {"count": len(self.skipped), "places": list(self.skipped[:NAMED])},
            "renamed": {"places": self.renamed, "sequences": dict(self.sequences), "cameras": dict(self.cameras)},
            "conflicts": list(self.conflicts),
        }


def check_encoders(map_: Map, other: Map) -> None:
    """See that two maps can be compared at all.

    Raises:
        WrongEncoder: they are of two encoders.
    """
    ours, theirs = map_.record.encoder, other.record.encoder
    if ours != theirs:
        raise WrongEncoder(
            f"The map {other.record.id} is bound to {theirs}, {map_.record.id} to {ours}: re-encode one of them first."
        )


def planned(map_: Map, other: Map, wanted: Mapping[str, Any], before: Sequence[Outline]) -> Plan:
    """What would be done.

    Args:
        wanted: ``on_conflict`` and ``prefix`` of the request.
        before: what this map held when the merge began.
    """
    rule, prefix = wanted["on_conflict"], wanted["prefix"]
    here = {place.id: place for place in before}
    coming: list[tuple[Outline, str]] = []
    skipped, conflicts, known, renamed = [], [], 0, 0
    clashing: list[str] = []
    unnamed: list[Outline] = []  # places that should come, but have no name to come under
    for place in other.transfer.outline():
        there = here.get(place.id)
        if there is not None and there.digest == place.digest:
            known += 1
        elif there is None:
            coming.append((place, place.id))
        elif rule == "skip":
            skipped.append(place.id)
        elif rule == "rename":
            name = prefix + place.id
            if (there := here.get(name)) is not None and there.digest == place.digest:
                known += 1
            elif there is not None or not _can_name_a_place(name):
                clashing.append(name)
                unnamed.append(place)
            else:
                renamed += 1
                coming.append((place, name))
        else:
            clashing.append(place.id)
            unnamed.append(place)
    if clashing:
        conflicts.append(f"{len(clashing)} ids mean other frames here: {', '.join(clashing[:NAMED])}.")
    given = {name for _, name in coming}
    if len(given) < len(coming):
        conflicts.append(f"{len(coming) - len(given)} places would get an id that another one has: choose a prefix.")
    wished = [place for place, _ in coming] + unnamed
    sequences, cameras = _other_names(map_, other, wanted, before, wished, conflicts)
    return Plan(coming, known, skipped, renamed, sequences, cameras, conflicts)


def _other_names(
    map_: Map,
    other: Map,
    wanted: Mapping[str, Any],
    before: Sequence[Outline],
    coming: Sequence[Outline],
    conflicts: list[str],
) -> tuple[dict[str, str], dict[str, str]]:
    """New names for sequences and cameras that mean something else here; what cannot be solved is a conflict."""
    rule, prefix = wanted["on_conflict"], wanted["prefix"]
    ours = {place.sequence for place in before}
    shared = sorted({place.sequence for place in coming if place.sequence is not None} & (ours - {None}))
    sequences = {name: prefix + name for name in shared} if rule == "rename" else {}
    if shared and rule == "refuse":
        conflicts.append(f"Both maps have the sequences {', '.join(shared[:NAMED])}.")
    if taken := [name for name in sequences.values() if name in ours or len(name) > 128]:
        conflicts.append(f"There are sequences {', '.join(taken[:NAMED])} already, or their names are too long.")
    masks = {camera.name: camera.mask for camera in map_.cameras.all()}
    used = {place.camera for place in coming}
    unlike = [c for c in other.cameras.all() if c.name in used and c.name in masks and masks[c.name] != c.mask]
    cameras = {camera.name: prefix + camera.name for camera in unlike} if rule == "rename" else {}
    if unlike and rule != "rename":
        conflicts.append(f"The cameras {', '.join(camera.name for camera in unlike[:NAMED])} have other masks here.")
    if taken := [new for name, new in cameras.items() if len(new) > 64 or (new in masks and masks[new] is not None)]:
        conflicts.append(f"There are cameras {', '.join(taken[:NAMED])} already, or their names are too long.")
    return sequences, cameras


def _can_name_a_place(name: str) -> bool:
    try:
        check_place_id(name)
    except InvalidIdentifier:
        return False
    return True


def merge(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Do, or go on with, what the job says: ``from``, ``on_conflict``, ``prefix``, ``dry_run``, ``sample``.

    Raises:
        UnknownMap, WrongEncoder, MergeConflict, EncoderNotInstalled, StorageFull, StorageFailure: the map is as
            it was.
    """
    map_ = context.map(engine.atlas)
    try:
        other = context.map(engine.atlas, context.arguments["from"])
        check_encoders(map_, other)
    except PlacerecError as error:
        if "after" in context.notes:
            with engine.writing(map_.record.id):
                _undo(context, map_, None, error)
        raise
    if "after" not in context.notes:
        outline = map_.transfer.outline()
        plan = planned(map_, other, context.arguments, outline)
        report = plan.report() | {
            "overlap": overlap(engine, context, map_, other) if context.arguments["sample"] else None
        }
        if context.arguments["dry_run"]:
            return report
        if plan.conflicts:
            raise MergeConflict(" ".join(plan.conflicts))
        ends = {name or "": end for name, end in map_.transfer.sequence_ends().items()}
        after = max((place.number for place in outline), default=0)
        coming = {name: place.digest.hex() for place, name in plan.coming}
        cameras = _new_cameras(map_, other, plan)
        context.remember(after=after, ends=ends, report=report, cameras=cameras, coming=coming)
    try:
        _take(engine, context, map_, other)
    except JobInterrupted:
        raise
    except BaseException as error:
        with engine.writing(map_.record.id):
            _undo(context, map_, other, error)
        raise
    return dict(context.notes["report"]) | {"places": map_.count_places()}


def _new_cameras(map_: Map, other: Map, plan: Plan) -> list[str]:
    there = {camera.name for camera in map_.cameras.all()}
    used = {place.camera for place, _ in plan.coming}
    names = [plan.cameras.get(camera.name, camera.name) for camera in other.cameras.all() if camera.name in used]
    return [name for name in names if name not in there]


def _held_before(context: JobContext, map_: Map) -> list[Outline]:
    return [place for place in map_.transfer.outline() if place.number <= context.notes["after"]]


def _take(engine: Engine, context: JobContext, map_: Map, other: Map) -> None:
    """Bring over what is not there yet, until all is."""
    for _ in range(ROUNDS):
        context.check_cancelled()
        here = {place.id: place.digest for place in map_.transfer.outline()}
        plan = planned(map_, other, context.arguments, _held_before(context, map_))
        coming = [(place, name) for place, name in plan.coming if name in context.notes["coming"]]
        due = [(place, name) for place, name in coming if here.get(name) != place.digest]
        if not due:
            return
        names = context.notes["report"]["renamed"]
        for camera in other.cameras.all():
            name = names["cameras"].get(camera.name, camera.name)
            if name in context.notes["cameras"]:
                map_.cameras.put(name, camera.mask)
        snapshot = other.snapshot()
        for first in range(0, len(due), CHUNK):
            yield_to_requests(engine, context)
            # No place may be enrolled under one of the ids between the look at them and the commit.
            with engine.writing(map_.record.id):
                _adopt(context, map_, other, snapshot, _still_free(context, map_, due[first : first + CHUNK]))
            context.progress(len(coming) - len(due) + min(first + CHUNK, len(due)), len(coming))


def _still_free(context: JobContext, map_: Map, due: Sequence[tuple[Outline, str]]) -> list[tuple[Outline, str]]:
    """What may come under its name: nobody has enrolled another frame there since the merge began.

    Raises:
        MergeConflict: somebody has, and such places are not to be skipped.
    """
    free: list[tuple[Outline, str]] = []
    for place, name in due:
        there = map_.digest(name)
        if there is None or there.hex() == context.notes["coming"][name]:
            free.append((place, name))
        elif context.arguments["on_conflict"] != "skip":
            raise MergeConflict(f"The place {name!r} was enrolled with another frame while the merge was under way.")
    return free


def _adopt(context: JobContext, map_: Map, other: Map, snapshot: Snapshot, due: Sequence[tuple[Outline, str]]) -> None:
    """One commit."""
    names, ends = context.notes["report"]["renamed"], context.notes["ends"]
    pictures = {place.id: other.picture(place.id) for place, _ in due}
    # Read behind the pictures: a place that is still in its row shows the frame that was read.  What was changed or
    # forgotten since it was listed is for the next round.
    found = other.transfer.find([place.id for place, _ in due])
    ready = [(p, name) for p, name in due if p.id in found and found[p.id][1] == p.row < snapshot.rows]
    rows = np.array([place.row for place, _ in ready], np.int64)
    descriptors, local = snapshot.descriptors_at(rows), snapshot.locals_at(rows)
    items = []
    for (place, name), descriptor, cells in zip(ready, descriptors, local, strict=True):
        stored = found[place.id][0]
        fields = {field: getattr(stored, field) for field in PlaceFields.model_fields}
        if stored.sequence is not None:
            fields["sequence"] = names["sequences"].get(stored.sequence, stored.sequence)
        if stored.camera is not None:
            fields["camera"] = names["cameras"].get(stored.camera, stored.camera)
        picture = pictures[place.id]
        item = Enrolment(
            id=name,
            fields=PlaceFields(**fields),
            descriptor=descriptor,
            regions=stored.regions,
            digest=place.digest,
            local=cells,
            thumbnail=picture if stored.picture == "thumbnail" else None,
            image=picture if stored.picture == "image" else None,
        )
        ordinal = ends.get(fields["sequence"] or "", 0) + place.ordinal
        items.append((item, History(stored.picture, ordinal, stored.created_at, stored.updated_at)))
    map_.transfer.adopt(items)


def _undo(context: JobContext, map_: Map, other: Map | None, error: BaseException) -> None:
    """Take out again what came; the map is then as it was.

    Raises:
        StorageFailure: that could not be done.
    """
    try:
        noted = {name: {bytes.fromhex(digest)} for name, digest in context.notes["coming"].items()}
        with suppress(PlacerecError):  # the other map is gone: its places came as they were noted
            for place, name in (
                [] if other is None else planned(map_, other, context.arguments, _held_before(context, map_)).coming
            ):
                if name in noted:
                    noted[name].add(place.digest)
        came = {
            place.id: place.digest
            for place in map_.transfer.outline()
            if place.id in context.notes["coming"]
            and place.number > context.notes["after"]
            and place.digest in noted[place.id]
        }
        map_.transfer.forget(came)
        for camera in context.notes["cameras"]:
            try:
                map_.cameras.forget(camera)
            except UnknownCamera:
                continue
    except UnknownMap:
        return  # it was deleted, with all that had come
    except PlacerecError as further:
        raise StorageFailure(
            f"The merge ended ({error or type(error).__name__}), and what it had brought could not be taken out again "
            f"({further}): places of the map {context.arguments['from']} remain; merge it again, or forget them."
        ) from error


NAMED = 20

_NO_REGIONS = Regions(
    np.empty((0, 4), np.int32),
    np.empty(0, np.float32),
    np.empty(0, np.int32),
    np.empty(0, np.int32),
    np.empty((0, 0), np.float32),
)
"""What was found in a frame that is not at hand any more; a search does not look at it."""


def overlap(engine: Engine, context: JobContext, map_: Map, other: Map) -> dict[str, Any]:
    """How many of the other map's places this one recognizes, by a sample of them spread over it."""
    encoder = engine.load_encoder(map_)
    outline, snapshot = other.transfer.outline(), other.snapshot()
    outline = [place for place in outline if place.row < snapshot.rows]  # not what is being written in this very moment
    chosen = [outline[i] for i in spread_order(len(outline))[: context.arguments["sample"]]]
    verdicts = {"recognized": 0, "ambiguous": 0, "unknown": 0}
    pairs: list[dict[str, Any]] = []
    apart: list[float] = []
    for first in range(0, len(chosen), TOGETHER):
        yield_to_requests(engine, context)
        some = chosen[first : first + TOGETHER]
        rows = np.array([place.row for place in some], np.int64)
        descriptors, local = snapshot.descriptors_at(rows), snapshot.locals_at(rows)
        encodings = [Encoding(d, cells, _NO_REGIONS, {}) for d, cells in zip(descriptors, local, strict=True)]
        there = other.transfer.find([place.id for place in some])
        for place, located in zip(some, locate(map_, encoder, encodings, 1), strict=True):
            verdicts[located.judgement.verdict] += 1
            if located.judgement.verdict != "recognized" or place.id not in there:
                continue
            score, match = located.matches[0]
            pairs.append({"place": place.id, "match": match.id, "score": float(score)})
            ours, theirs = match.pose, there[place.id][0].pose
            if ours is not None and theirs is not None and ours.kind() == theirs.kind():
                apart.append(float(np.linalg.norm(ours.position() - theirs.position())))
        context.progress(first + len(some), len(chosen), "compares the maps")
    pairs.sort(key=lambda pair: -pair["score"])
    return {
        "examined": len(chosen),
        "of": len(outline),
        **verdicts,
        "metres_apart": median(apart) if apart else None,
        "pairs": pairs[:NAMED],
    }
