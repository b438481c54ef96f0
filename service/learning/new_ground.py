"""New ground: stretches of a run off the map wait for review, and become places once an operator accepts one.

A stretch waits as its frames, among the frames stored for review; each says of which stretch it is, and which place it
would become.  A map takes none by itself, whatever its setting.  That a stretch is accepted is a job, which goes on
after a restart: all its places are stored in one commit, and to store them again changes nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from core.belief import PlaceGraph
from core.errors import RevisionMismatch, UnknownStretch
from core.learning import GroundStretch, Lesson, RunFrame, new_ground_of
from core.learning.new_ground import LEAST_FRAMES
from core.ledger.maps.review import stored_frames
from core.maps import LearningSetting, RejectedGround, ReviewFrame, ReviewSetting
from core.maps.records import MOST_POSES, MOST_REJECTED
from core.maps.stored_fields import moment_text
from core.places import Place, PlaceFields, Pose
from core.store import Map
from service.access.audit import ASKER
from service.engine.engine import Engine, camera_mask
from service.engine.queue import RequestDeadline
from service.errors.faults import TooManyPlaces
from service.jobs.context import JobContext, run_after_requests
from service.learning.run_notes import RunNotes
from service.places.enrolment import Enrolled, FrameToEnrol, LookOrigin, enrol

KIND = "accept-stretch"

KNOWN = 0.5
"""A stretch of which at least this share lies where another one waits, or was rejected, is not proposed."""

LeastScore = Callable[[int], float | None]
"""Returns the score from which on a match with a frame of the run is believed; None: it cannot become a place."""


@dataclass(frozen=True)
class WaitingStretch:
    """A stretch that waits for review.

    id: of the stretch, and the name of the sequence that its places are going to be.
    told: what all of its frames say of it.
    frames: those that are stored and have no label that says otherwise, in the order of the run.
    """

    id: str
    told: Mapping[str, Any]
    frames: Sequence[ReviewFrame]

    @property
    def open(self) -> bool:
        """Whether a frame of it has no label yet."""
        return any(frame.label is None for frame in self.frames)

    @property
    def poses(self) -> list[Pose]:
        """Those of the frames."""
        return [Pose(**frame.answer["stretch"]["pose"]) for frame in self.frames]


# Proposing


def propose(
    map_: Map, notes: RunNotes, frames: Sequence[RunFrame], graph: PlaceGraph, lesson: Lesson, least: LeastScore
) -> Mapping[str, Any]:
    """Store the stretches of a run off the map for review.

    Returns:
        JSON: how many are stored, and why others are not: as of ``core.learning.new_ground.GroundRefusal``; the map has
        changed meanwhile; too few frames have a cohort; the limits of review are too small; another stretch of the same
        ground waits already, or was rejected before; or the map has learnt as many places as it may.
    """
    found = new_ground_of(frames, graph, lesson)
    refused: dict[str, int] = {str(why): count for why, count in found.refused.items()}
    count = 0
    for stretch in found.stretches:
        refusal = _store(map_, notes, stretch, least)
        count += refusal is None
        if refusal is not None:
            refused[refusal] = refused.get(refusal, 0) + 1
    return {"stretches": count, "refused": refused}


def _store(map_: Map, notes: RunNotes, stretch: GroundStretch, least: LeastScore) -> str | None:
    """Store a stretch for review; returns why it is not."""
    origin, end = map_.places_at([stretch.origin, stretch.end])
    if origin is None or end is None or origin.pose is None:
        return "changed"
    leasts = {one.frame: least(one.frame) for one in stretch.frames}
    stretch = replace(stretch, frames=tuple(one for one in stretch.frames if leasts[one.frame] is not None))
    if len(stretch.frames) < LEAST_FRAMES:
        return "cohort"
    setting = map_.record.review or ReviewSetting()
    if not setting.allows(len(stretch.frames), sum(len(notes.frames[one.frame].data) for one in stretch.frames)):
        return "size"
    if not has_room(map_, len(stretch.frames)):
        return "most places"
    poses = [one.pose(origin.pose) for one in stretch.frames]
    radius = map_.record.same_place_radius
    if any(covers(rejected.poses, poses, radius) for rejected in map_.record.learning.rejected_ground):
        return "rejected before"
    if covers([pose for one in stretches(map_) if one.open for pose in one.poses], poses, radius):
        return "waits already"
    name = f"{notes.session}-{hashlib.sha256(notes.frames[stretch.frames[0].frame].data).hexdigest()[:8]}"
    told = {
        "id": name,
        "run": notes.session,
        "source": str(notes.source),
        "frames": len(stretch.frames),
        "leaves": origin.id,
        "returns": end.id,
        "length": round(stretch.length, 2),
        "misclosure": round(stretch.misclosure, 2),
        "misclosure_heading": round(float(np.degrees(stretch.misturned)), 1),
        "recognized_elsewhere": stretch.recognized,
        "why": _reason(stretch, origin, end),
    }
    for number, (one, pose) in enumerate(zip(stretch.frames, poses, strict=True)):
        noted = notes.frames[one.frame]
        own = {
            "place": f"{name}-{number:03d}",
            "frame": one.frame,
            "pose": pose.model_dump(exclude_none=True),
            "spread": round(one.spread, 2),
            "heading_spread": round(float(np.degrees(one.heading_spread)), 1),
            "least_score": leasts[one.frame],
            "taken": None if noted.taken is None else moment_text(noted.taken),
        }
        map_.review.keep(noted.data, {**noted.answer, "stretch": told | own}, setting, renew=True)
    return None


def has_room(map_: Map, places: int) -> bool:
    """Whether a map may learn so many places more."""
    most = map_.record.learning.most_places
    return most is None or map_.count_learnt() + places <= most


def covers(there: Sequence[Pose], poses: Sequence[Pose], radius: float) -> bool:
    """Whether most poses of a stretch are within a radius of those of others."""
    known = np.array([one.position() for one in there if one.kind() == poses[0].kind()])
    if not len(known):
        return False
    near = [np.linalg.norm(known - one.position(), axis=1).min() <= radius for one in poses]
    return float(np.mean(near)) >= KNOWN


def _reason(stretch: GroundStretch, origin: Place, end: Place) -> str:
    spread = max(one.spread for one in stretch.frames)
    text = (
        f"{len(stretch.frames)} frames, {stretch.length:.0f} m: the run leaves the map at {origin.id} and comes back "
        f"at {end.id}. Odometry misses the place of return by {stretch.misclosure:.1f} m and "
        f"{np.degrees(stretch.misturned):.0f}°, which its drift explains; positions are known to {spread:.1f} m."
    )
    elsewhere = stretch.recognized
    return f"{text} {elsewhere} frames were recognized at other places of the map." if elsewhere else text


# Reviewing


def stretches(map_: Map) -> list[WaitingStretch]:
    """The stretches of which frames are stored for review, also accepted ones, the oldest first."""
    found: dict[str, list[ReviewFrame]] = {}
    for frame in reversed([one for one in stored_frames(map_.review) if "stretch" in one.answer]):
        told = frame.answer["stretch"]
        if frame.label is None or frame.label["label"].get("new") == told["place"]:
            found.setdefault(told["id"], []).append(frame)
    return [_stretch(name, frames) for name, frames in sorted(found.items(), key=lambda one: one[1][0].number)]


def _stretch(name: str, frames: Sequence[ReviewFrame]) -> WaitingStretch:
    ordered = sorted(frames, key=lambda frame: frame.answer["stretch"]["place"])
    return WaitingStretch(name, ordered[0].answer["stretch"], ordered)


def find(map_: Map, name: str) -> WaitingStretch:
    """A stretch that waits for review.

    Raises:
        UnknownStretch: there is none of this id, or it has its labels already.
    """
    for one in stretches(map_):
        if one.id == name and one.open:
            return one
    raise UnknownStretch(f"The map has no stretch {name[:140]!r} that waits for review.")


def reject(map_: Map, name: str) -> int:
    """Throw the frames of a stretch away that have no label, and remember where it is; returns how many.

    Raises:
        UnknownStretch: there is none of this id, or it has its labels already.
        StorageFull, StorageFailure: some frames may be left, and the stretch waits with these.
    """
    found = find(map_, name)
    outline = np.unique(np.linspace(0, len(found.poses) - 1, MOST_POSES).round().astype(int)).tolist()
    poses = tuple(found.poses[at] for at in outline)
    one = RejectedGround(stretch=name, run=str(found.told["run"]), at=datetime.now(UTC), poses=poses)
    _remember(map_, lambda rejected: [*(other for other in rejected if other.stretch != name), one][-MOST_REJECTED:])
    going = [frame.number for frame in found.frames if frame.label is None]
    for number in going:
        map_.review.discard(number)
    return len(going)


def forget_rejected(map_: Map, run: str) -> None:
    """Forget where the stretches of a run are that were rejected; another run may propose the ground again."""
    _remember(map_, lambda rejected: [one for one in rejected if one.run != run])


def _remember(map_: Map, change: Callable[[Sequence[RejectedGround]], Sequence[RejectedGround]]) -> None:
    """Change which ground is rejected, whoever else edits the map in the same moment."""
    while True:
        record = map_.record
        rejected = tuple(change(record.learning.rejected_ground))
        if rejected == record.learning.rejected_ground:
            return
        setting = LearningSetting(**record.learning.model_dump() | {"rejected_ground": rejected})
        try:
            map_.edit({"learning": setting}, record.revision)
            return
        except RevisionMismatch:
            continue


def check_room(map_: Map, stretch: WaitingStretch) -> None:
    """Check that a map may learn the places of a stretch.

    Raises:
        TooManyPlaces: its setting ``most_places`` says otherwise.
    """
    there = map_.rows_of([frame.answer["stretch"]["place"] for frame in stretch.frames])  # after a restart
    missing = there.count(None)
    if not has_room(map_, missing):
        most, learnt = map_.record.learning.most_places, map_.count_learnt()
        raise TooManyPlaces(
            f"The map may learn {most} places (most_places of its setting learning) and has learnt {learnt}: there is "
            f"no room for {missing} more."
        )


def accept(engine: Engine, context: JobContext) -> Mapping[str, Any]:
    """Make the frames of a stretch places of the map, all in one commit, and label them so.

    Returns:
        JSON: the stretch, its run, and how its places changed.

    Raises:
        UnknownMap, UnknownCamera, EncoderNotInstalled, NoRegions, StorageFull, StorageFailure: no place was stored.
        TooManyPlaces: likewise; the map, or its setting ``most_places``, has no room.
        JobCancelled, JobInterrupted.
    """
    map_, name = context.map(engine.maps), str(context.arguments["stretch"])
    found = next((one for one in stretches(map_) if one.id == name), None)
    if found is None:
        raise UnknownStretch(f"The map has no stretch {name[:140]!r} for review.")
    check_room(map_, found)
    with ExitStack() as held:
        for frame in found.frames:
            held.enter_context(map_.review.held(frame.number))

        async def work(deadline: RequestDeadline) -> dict[int, Enrolled]:
            frames = [await _to_enrol(map_, found, frame) for frame in found.frames]
            return await enrol(engine, map_, frames, deadline, queued=False)

        stored = run_after_requests(engine, context, work)
        for frame in found.frames:
            if frame.label is None:
                map_.review.label(frame.number, _label(frame))
    changes: dict[str, int] = {}
    for one in stored.values():
        changes[one.change] = changes.get(one.change, 0) + 1
    return {"stretch": name, "run": found.told["run"], "places": len(stored), "changes": changes}


async def _to_enrol(map_: Map, stretch: WaitingStretch, frame: ReviewFrame) -> FrameToEnrol:
    told, camera = frame.answer["stretch"], frame.answer.get("camera")
    taken = None if told["taken"] is None else datetime.fromisoformat(told["taken"])
    fields = PlaceFields(pose=Pose(**told["pose"]), timestamp=taken, sequence=stretch.id, camera=camera)
    origin = LookOrigin(told["run"], told["least_score"])
    data = map_.review.picture(frame.number)
    return FrameToEnrol(told["place"], fields, data, await camera_mask(map_, camera), origin=origin)


def _label(frame: ReviewFrame) -> Mapping[str, Any]:
    asker = ASKER.get()
    by = asker.principal if asker.key else None
    return {"label": {"new": frame.answer["stretch"]["place"]}, "at": datetime.now(UTC).isoformat(), "by": by}
