"""The job that enrols the frames of a bag, as ``placerec enrol`` does."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from core.belief.view import STILL, View, view_of
from core.errors import InvalidImage, InvalidRecording, InvalidTrajectory
from core.frames.images import decode
from core.frames.masks import Mask, range_in
from core.places import Camera, Level, PlaceFields, PoseAccuracy, check_sequence, coordinates_of
from core.places import Sequence as TraverseName
from core.recordings import RecordedFrame, Recording
from core.recordings.keyframes import Left, Spacing, keyframes, moving
from core.recordings.paths import check_lost_poses, traverse_of, way_of
from core.recordings.pictures import range_remark, used_range
from core.recordings.plausibility import MOST_SPEED
from core.recordings.recording import LARGEST_GAP
from core.store import Map
from service.engine.engine import Engine
from service.errors.faults import PlacesTaken
from service.http.multipart import FormPart
from service.http.uploads import check_part
from service.jobs.context import JobContext, JobGivesWay, yield_to_requests
from service.places.bulk_enrolment import Align, EnrolmentInCommits
from service.places.comparison import compare, expect_coordinates, taken_text
from service.places.enrolment import FrameToEnrol
from service.places.map_events import tell_map
from service.places.plausible import pose_remarks
from service.recordings.reader import Order, as_fields
from service.recordings.readers import Readers, Turns
from service.recordings.uploads import KIND, Recordings
from service.settings import Settings

__all__ = ["KIND", "RecordingOrder", "enrol_recording"]

KEPT = (
    "Some frames failed, so the uploaded bag is kept: it can be enrolled again, after the remedy that the failures "
    "name, and is removed when all of its frames are in, or nothing was done with it for a day."
)

Metres = Field(default=None, gt=0, le=1e6, allow_inf_nan=False)
Topic = Field(default=None, min_length=1, max_length=256)


class RecordingOrder(BaseModel):
    """Which frames of a bag are enrolled, and how; as the options of ``placerec enrol``."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"sequence": "monday", "pose_topic": "/odom", "every_metres": 1}]},
    )

    sequence: TraverseName | None = Field(default=None, description="The traverse; null: as the file is called.")
    named: bool = Field(
        default=True,
        strict=True,
        description="Whether somebody chose the traverse's name; another one is made unique, as `places:compare` does.",
    )
    id_prefix: str = Field(default="", max_length=64, description="Before the ids, which are made of topic and stamp.")
    camera: Camera | None = Field(default=None, description="Of the map; its mask is applied.")
    level: Level | None = Field(default=None, description="The storey on which its frames were taken.")
    pose_accuracy: PoseAccuracy | None = Field(default=None, description="How exact its poses are.")
    topic: str | None = Topic
    pose_topic: str | None = Topic
    fixed_frame: str | None = Topic
    moving_frame: str | None = Topic
    largest_gap: float = Field(
        default=LARGEST_GAP, gt=0, le=3600, allow_inf_nan=False, description="Seconds between poses that are bridged."
    )
    most_speed: float = Field(
        default=MOST_SPEED,
        ge=1,
        le=1e6,
        allow_inf_nan=False,
        description="Metres a second of the vehicle at most: poses that are reached faster are left out.",
    )
    allow_lost_poses: bool = Field(
        default=False,
        strict=True,
        description="Also enrol a bag of which more than a tenth of the frames lose their pose, as no vehicle can have "
        "driven so; without it, the job fails and nothing is enrolled.",
    )
    every_metres: float | None = Metres
    every_degrees: float | None = Field(default=None, gt=0, le=180, allow_inf_nan=False)
    every_seconds: float | None = Metres
    keep_standing: bool = Field(
        default=False, strict=True, description="Also enrol frames in which nothing changes, as where the robot stood."
    )
    replace: bool = Field(
        default=False,
        strict=True,
        description="Replace places of other frames that have these ids; else it is refused.",
    )
    align: bool = Field(
        default=False, strict=True, description="Then find which frames show places that the map had already."
    )

    @model_validator(mode="after")
    def _goes_together(self) -> RecordingOrder:
        if self.pose_topic is None and (self.fixed_frame is not None or self.moving_frame is not None):
            raise ValueError("fixed_frame and moving_frame go with a pose_topic of transforms, such as /tf")
        return self


def enrol_recording(
    engine: Engine, recordings: Recordings, readers: Readers, align: Align, context: JobContext
) -> Mapping[str, Any]:
    """Choose frames of a bag and enrol them, some with each commit; an attempt after a restart goes on behind them.

    Returns:
        As of a job that enrols a form; with ``frames``, how many the bag has, ``posed``, how many of the chosen ones
        have a pose, ``path``, how long their path is, ``sequences``, all traverses, and ``remarks`` on the bag.

    Raises:
        InvalidRecording, UnknownTopic, InvalidTrajectory, MissingExtra: the bag cannot be used so, or too many frames
            lose their pose.
        MixedCoordinates: its poses are of the kind that the map's are not; nothing was stored.
        NothingEnrolled: every frame failed.
        InvalidIdentifier: the name of a later part of the traverse is too long.
        UnknownMap, UnknownCamera, EncoderNotInstalled, TooManyPlaces, StorageFull, StorageFailure: what was stored
            before stays.
        JobCancelled, JobInterrupted, JobGivesWay.
    """
    map_, file = context.map(engine.maps), str(context.arguments["recording"])
    order = RecordingOrder.model_validate(context.arguments["order"])
    context.progress(0, None, "reading the recording")
    map_.cameras.mask(order.camera)  # an unknown one is refused before the bag is read
    wanted = Order(
        path=recordings.find(str(context.map_id), file),
        topic=order.topic,
        pose_topic=order.pose_topic,
        fixed=order.fixed_frame,
        moving=order.moving_frame,
        largest_gap=order.largest_gap,
        most_speed=order.most_speed,
        prefix=order.id_prefix,
        most=engine.settings.max_image_bytes + 1,  # so that more is noticed
    )
    with readers.reading(context, wanted) as (reader, turns):
        recording = reader.recording()
        name = order.sequence or recording.name
        for traverse in {traverse_of(name, one) for one in recording.frames}:
            check_sequence(traverse)
        if not order.allow_lost_poses:
            _check_lost_poses(recording)
        if "chosen" not in context.notes:
            expect_coordinates(map_, coordinates_of(one.pose for one in recording.frames))
        if "camera" not in context.notes:
            recording.check_format()
            context.remember(camera=_complete_camera(engine, map_, order.camera, recording))
        mask = map_.cameras.mask(order.camera)
        if "chosen" in context.notes:  # by an attempt before this one
            chosen, remarks = [recording.frames[number] for number in context.notes["chosen"]], context.notes["remarks"]
            sequence = str(context.notes.get("sequence", name))
        else:
            chosen, remarks = _choose(engine, context, turns, recording, order, mask)
            sequence = name
            if not order.replace:
                named = order.named and order.sequence is not None
                sequence = _compare(engine, context, map_, chosen, name, named, mask)
            if sequence != name:
                remarks.append(f"The map has a traverse {name} already; these frames are in {sequence}.")
            remarks += context.notes["camera"]
            numbers = {frame.id: number for number, frame in enumerate(recording.frames)}
            chosen_numbers = [numbers[frame.id] for frame in chosen]
            context.remember(chosen=chosen_numbers, sequence=sequence, remarks=remarks, looks=None)

        def frame(position: int) -> FrameToEnrol:
            turns.begin_step()
            try:
                traverse = traverse_of(sequence, chosen[position])
                return _to_enrol(chosen[position], traverse, order, mask, engine.settings)
            finally:
                turns.end_step()

        entries = [{"id": one.id} for one in chosen]
        result = EnrolmentInCommits(engine, context, entries, frame, gives_way=False, replace=order.replace).run()
        posed = sum(one.pose is not None for one in chosen)
        facts = {"sequence": sequence, "frames": len(recording.frames), "chosen": len(chosen), "posed": posed}
        traverses = list(dict.fromkeys(traverse_of(sequence, one) for one in chosen))
    if result["failed"]["count"]:
        remarks = [*remarks, KEPT]
    remarks = [*remarks, *pose_remarks(context.map(engine.maps), traverses)]
    told = {**result, **facts, "sequences": traverses, "path": way_of(chosen), "remarks": remarks}
    return {**told, "aligned": align(engine, context, traverses)} if order.align else told


def _check_lost_poses(recording: Recording) -> None:
    """Refuse a bag of which too many frames lose their pose.

    Raises:
        InvalidTrajectory: they do; the text has fields of the order.
    """
    try:
        check_lost_poses(recording)
    except InvalidTrajectory as error:
        raise InvalidTrajectory(as_fields(str(error))) from error


def _choose(
    engine: Engine, context: JobContext, turns: Turns, recording: Recording, order: RecordingOrder, mask: Mask | None
) -> tuple[list[RecordedFrame], list[str]]:
    """The frames to enrol, and remarks.

    Raises:
        InvalidRecording: no frame can be judged by the measures.
        JobCancelled, JobInterrupted, JobGivesWay.
    """
    frames, remarks = recording.frames, list(recording.remarks)
    spacing = Spacing(order.every_metres, order.every_degrees, order.every_seconds)
    if spacing:
        left = Left()
        frames = list(keyframes(frames, spacing, None, left))
        if not frames:
            raise InvalidRecording("No frame has the pose or the time by which keyframes are to be chosen.")
        if left.unjudged:
            remarks.append(f"{left.unjudged} frames lack the pose or the time that is needed, and are left out.")
    if not order.keep_standing:
        before = len(frames)
        frames = _moving(engine, context, turns, frames, mask)
        if len(frames) < before:
            remarks.append(f"{before - len(frames)} of {before} frames show the same as the one before them.")
    return frames, remarks


def _moving(
    engine: Engine, context: JobContext, turns: Turns, frames: list[RecordedFrame], mask: Mask | None
) -> list[RecordedFrame]:
    """The frames in which something changes; those that were looked at are noted when the job gives way.

    Raises:
        JobCancelled, JobInterrupted, JobGivesWay.
    """
    begin, numbers = context.notes.get("looks") or (0, [])
    found = [frames[number] for number in numbers]
    looked = begin

    def look(frame: RecordedFrame) -> View | None:
        nonlocal looked
        again = bool(numbers) and frame is frames[numbers[-1]]  # the last one of the attempt before this one
        if not again:
            turns.begin_step()
        yield_to_requests(engine, context)
        context.progress(looked, len(frames), "looking for stops")
        shown = _view(frame, mask)
        if not again:
            looked += 1
            turns.end_step()
        return shown

    last = found[-1] if found else None
    try:
        # What was found before the job gives way stays in the list.
        found.extend(moving(frames, look, lambda one, other: one.change(other) < STILL, begin, last))
    except JobGivesWay:
        place = {frame.id: number for number, frame in enumerate(frames)}
        context.remember(looks=(looked, [place[frame.id] for frame in found]))
        raise
    return found


def _view(frame: RecordedFrame, mask: Mask | None) -> View | None:
    try:
        return view_of(decode(frame.load(), value_range=range_in(mask)), mask)
    except (InvalidImage, InvalidRecording, OSError):
        return None  # what is wrong with it is said where it is enrolled


def _complete_camera(engine: Engine, map_: Map, camera: str | None, recording: Recording) -> list[str]:
    """Give a camera of the map what it has not and the recording shows: intrinsics, and the range of values of 16 bits.

    Returns:
        What is to be said of it.

    Raises:
        UnknownCamera, StorageFull, StorageFailure.
        JobCancelled, JobInterrupted.
    """
    known = None if camera is None else map_.cameras.find(camera)
    mask, intrinsics, value_range = (None, None, None) if known is None else known.settings()
    remarks = []
    if intrinsics is None and recording.intrinsics is not None:
        intrinsics = recording.intrinsics
        remarks.append(
            "It has the intrinsics of its camera, which a camera of the map gets if one is named."
            if camera is None
            else f"The camera {camera} had no intrinsics, and has those of the bag now."
        )
    if value_range is None and (value_range := used_range(recording.frames)) is not None:
        remarks.append(range_remark(value_range, camera))
    if remarks and camera is not None:
        map_.cameras.put(camera, mask, intrinsics, value_range)
        tell_map(engine, map_, "cameras")
    return remarks


def _compare(
    engine: Engine,
    context: JobContext,
    map_: Map,
    frames: Sequence[RecordedFrame],
    sequence: str,
    named: bool,
    mask: Mask | None,
) -> str:
    """The name under which to enrol frames, of which the map may have some already.

    Raises:
        PlacesTaken: places of other frames or of other traverses have their ids.
        JobCancelled, JobInterrupted.
    """
    found = compare(map_, {frame.id: None for frame in frames}, sequence, named, mask)
    if found.taken:
        taken = {one.id for one in found.taken}
        digests: dict[str, bytes | None] = {}
        for frame in (one for one in frames if one.id in taken):
            yield_to_requests(engine, context)
            try:
                digests[frame.id] = hashlib.sha256(frame.load()).digest()
            except (InvalidRecording, OSError):
                continue  # what is wrong with it is said where it is enrolled
        found = compare(map_, digests, sequence, named, mask)
    if found.taken:
        told = taken_text(found.taken, len(frames))
        raise PlacesTaken(f"{told} Give another sequence and an id_prefix, or replace.")
    return str(found.sequence)


def _to_enrol(
    frame: RecordedFrame, sequence: str, order: RecordingOrder, mask: Mask | None, settings: Settings
) -> FrameToEnrol:
    """A frame as it is enrolled.

    Raises:
        InvalidImage, UnsupportedMediaType, ImageTooLarge: it cannot be.
    """
    try:
        data = frame.load()
    except (InvalidRecording, OSError) as error:
        raise InvalidImage(str(error)) from error
    oversized = len(data) > settings.max_image_bytes
    check_part(FormPart(frame.name, None, None, b"" if oversized else data, oversized), settings)
    fields = PlaceFields(
        pose=frame.pose, timestamp=frame.timestamp, sequence=sequence, camera=order.camera, level=order.level,
        pose_accuracy=order.pose_accuracy,
    )  # fmt: skip
    return FrameToEnrol(frame.id, fields, data, mask)
