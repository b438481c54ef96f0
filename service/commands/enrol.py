"""``placerec enrol``: enrol the frames of a recording as places of a map."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import shlex
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from core.errors import InvalidIdentifier
from core.names import LONGEST
from core.places import accuracy_of, check_sequence, coordinates_of
from placerec_client.errors import InvalidFrame
from service.commands.connection.batches import FrameToSend, SendingOutcome, enrol_frames, load
from service.commands.connection.client import CommandTarget, DataDir, Refused, Service, Url, open_service, path_of, run
from service.commands.console import Failure, complain, progress, remark, say
from service.commands.jobs import offered_calibration, show_outcome, submit
from service.commands.options.recordings import (
    PANEL,
    EveryChange,
    EveryDegrees,
    EveryMetres,
    EverySeconds,
    FixedFrame,
    LargestGap,
    MostSpeed,
    MovingFrame,
    PosesFrom,
    PoseTopic,
    RecordingOptions,
    Topic,
    TrajectoryFile,
    TrajectoryTimes,
    without_stops,
)

if TYPE_CHECKING:
    from core.frames.masks import Mask
    from core.recordings import Recording


@dataclass
class Report:
    """The outcomes of the frames so far."""

    changes: Counter[str] = field(default_factory=Counter)
    posed: int = 0
    uploaded: int = 0
    failures: list[tuple[str, str]] = field(default_factory=list)

    def add(self, outcome: SendingOutcome) -> None:
        """Count one frame."""
        self.uploaded += outcome.uploaded
        if outcome.change is None:
            self.failures.append((outcome.frame.name, str(outcome.refusal)))
        else:
            self.changes[outcome.change] += 1
            self.posed += outcome.posed


@dataclass(frozen=True)
class _Wanted:
    """How the traverse is called, whether somebody chose this name, and whether places of other frames are replaced."""

    sequence: str
    named: bool
    replace: bool


def enrol(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="One traverse: a directory of images, a bag (rosbag2, ROS 1) or a video.",
            show_default=False,
        ),
    ],
    map_id: Annotated[str, typer.Option("--map", "-m", help="The map to enrol into.", show_default=False)],
    create: Annotated[bool, typer.Option("--create", help="Create the map if there is none.")] = False,
    encoder: Annotated[
        str | None,
        typer.Option(help="Encoder of a map that is created; for an existing map, the encoder that it must have."),
    ] = None,
    keep: Annotated[
        Literal["none", "thumbnail", "image"] | None,
        typer.Option(help="Pictures that a map that is created stores of each frame."),
    ] = None,
    sequence: Annotated[
        str | None,
        typer.Option(
            help="Name of the traverse; default: the name of RECORDING, with ~2 and so on where the map has another "
            "traverse of this name.",
            show_default=False,
        ),
    ] = None,
    id_prefix: Annotated[str, typer.Option(help="Prefix of the ids that are made from names of files or topics.")] = "",
    replace_places: Annotated[
        bool,
        typer.Option(
            "--replace", help="Replace places of other frames that have these ids; without it nothing is sent then."
        ),
    ] = False,
    camera: Annotated[
        str | None, typer.Option(help="Camera of the map that took the images; its mask is applied.")
    ] = None,
    level: Annotated[
        str | None, typer.Option(help="Storey on which the frames were taken that places.csv gives none.")
    ] = None,
    accuracy: Annotated[
        float | None,
        typer.Option(
            "--pose-accuracy",
            help="Metres: standard deviation of the coordinates of poses whose accuracy places.csv does not give.",
            min=0,
            max=1e6,
        ),
    ] = None,
    align: Annotated[
        bool, typer.Option("--align", help="Then find which frames show places that the map had already.")
    ] = False,
    topic: Topic = None,
    pose_topic: PoseTopic = None,
    fixed_frame: FixedFrame = None,
    moving_frame: MovingFrame = None,
    trajectory: TrajectoryFile = None,
    trajectory_times: TrajectoryTimes = None,
    poses: PosesFrom = None,
    largest_gap: LargestGap = None,
    most_speed: MostSpeed = None,
    allow_lost_poses: Annotated[
        bool,
        typer.Option(
            "--allow-lost-poses",
            help="Also enrol a recording of which more than a tenth of the frames lose their pose, as no vehicle can "
            "have driven so.",
            rich_help_panel=PANEL,
        ),
    ] = False,
    every_metres: EveryMetres = None,
    every_degrees: EveryDegrees = None,
    every_seconds: EverySeconds = None,
    every_change: EveryChange = None,
    keep_standing: Annotated[
        bool,
        typer.Option(
            "--keep-standing",
            help="Of a bag or a video: also enrol the frames in which nothing changes, as where the robot stood.",
            rich_help_panel=PANEL,
        ),
    ] = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Enrol the frames of a recording, in their order, as places of a map.

    A directory of images is taken in natural order. Poses come from places.csv in it
    (file,id,x,y,z,heading,latitude,longitude,timestamp,level,accuracy_metres,accuracy_degrees; only file is required;
    floor, storey or story for level), or else from the file names if more
    than half are of the form @east@north@…@heading@…@.jpg, or else from the EXIF data of the images; ids are the file
    names without their extension. The frames of a bag are taken in the order of their header stamps, of which their
    ids are made; those of a video are numbered. Of both, frames that show what the one before shows, as where the
    robot stood, are left out. A frame that is neither JPEG nor PNG nor WebP is sent as PNG.
    The command can be interrupted and run again: a frame that is already enrolled is not sent again. Where the map has
    places of other frames under these ids, nothing is sent, unless they are to be replaced.
    """
    options = RecordingOptions(
        topic,
        pose_topic,
        trajectory,
        trajectory_times,
        largest_gap,
        every_metres,
        every_degrees,
        every_seconds,
        every_change,
        fixed_frame,
        moving_frame,
        most_speed,
        poses,
    )
    target = CommandTarget(url, data_dir)
    began = time.monotonic()
    with options.open(recording, id_prefix) as opened:
        from core.recordings.paths import check_lost_poses, traverse_of, way_of  # here because it takes a moment

        chosen_name = _checked_sequence(opened.name if sequence is None else sequence)
        wanted = _Wanted(chosen_name, sequence is not None, replace_places)
        for one in {traverse_of(chosen_name, frame) for frame in opened.frames}:
            _checked_sequence(one)
        if not allow_lost_poses:
            check_lost_poses(opened, remarked=True)

        def choose(used: str | None, mask: Mask | None) -> list[FrameToSend]:
            chosen = options.choose(opened, used, mask)
            chosen = chosen if keep_standing else without_stops(opened, chosen, mask)
            if (way := way_of(chosen)) is not None:
                remark(f"{way[0].upper()}{way[1:]}.")
            exact = accuracy_of(accuracy or None, None)
            chosen = [
                replace(one, level=one.level or level, pose_accuracy=one.pose_accuracy or exact) for one in chosen
            ]
            return [FrameToSend(taken, wanted.sequence, camera) for taken in chosen]

        report, frames, traverses = run(
            _enrol(target, map_id, choose, wanted, camera, create, {"encoder": encoder, "keep": keep}, opened)
        )
    _show(report, map_id, ", ".join(traverses), frames, time.monotonic() - began)
    for one in traverses if align else ():
        _show_aligned(submit(target, path_of("maps", map_id, "align"), {"sequence": one}, wait=True))
    if report.failures:
        raise typer.Exit(1)


def _checked_sequence(name: str) -> str:
    """Return ``name`` if a traverse may have it.

    Raises:
        Failure: a traverse may not have this name.
    """
    try:
        return check_sequence(name)
    except InvalidIdentifier as error:
        raise Failure(f"{error} Give another one with --sequence.") from error


def _show_aligned(job: dict[str, Any]) -> None:
    """Say what the job has found.

    Raises:
        Failure: it has failed or was cancelled.
    """
    if job["state"] != "succeeded":
        show_outcome(job, as_json=False)
        return
    found = job["result"]
    paired = ", ".join(f"{one['sequence']}: {one['paired']}" for one in found["traverses"] if one["paired"])
    say(
        f"{found['paired']} of {found['frames']} frames show places of other traverses"
        f"{f' ({paired})' if paired else ''}; "
        f"{found['poses_handed_over']} poses were handed over."
    )
    if "calibration" in found:
        say(f"Calibration: {offered_calibration(found['calibration']).rstrip('.')}.")


async def _enrol(
    target: CommandTarget,
    map_id: str,
    choose: Callable[[str | None, Mask | None], list[FrameToSend]],
    wanted: _Wanted,
    camera: str | None,
    create: bool,
    settings: dict[str, str | None],
    opened: Recording,
) -> tuple[Report, int, list[str]]:
    """Enrol the frames that ``choose`` gives for the map's encoder and the camera's mask.

    Returns:
        The outcome, the number of frames, and the names of their traverses.
    """
    from core.recordings.paths import traverse_of  # here because it takes a moment

    report = Report()
    async with open_service(target) as service:
        given = {key: value for key, value in settings.items() if value is not None}
        used, created = await _ready_map(service, map_id, camera, create, given)
        under_way = False  # and what the service has of it is not known
        try:
            mask = await _mask(service, map_id, camera, opened)
            frames = await asyncio.to_thread(choose, used, mask)
            known, name = await _compare(service, map_id, frames, wanted, camera)
            if name != wanted.sequence:
                remark(f"The map has a traverse {wanted.sequence!r} already; these frames are in {name!r}.")
            frames = [replace(frame, sequence=traverse_of(name, frame.taken)) for frame in frames]
            with progress() as bar:
                task, under_way = bar.add_task(f"Enrolling into {map_id}", total=len(frames)), True

                def report_frame(outcome: SendingOutcome) -> None:
                    report.add(outcome)
                    bar.advance(task)

                try:
                    await enrol_frames(
                        service, map_id, frames, known, settings["encoder"], report_frame, wanted.replace
                    )
                except (Failure, asyncio.CancelledError) as error:
                    how_far = (
                        f"{sum(report.changes.values())} of {len(frames)} frames are enrolled; run the command again"
                    )
                    if isinstance(error, Failure):
                        raise Failure(f"{error} {how_far} to continue.") from error
                    raise KeyboardInterrupt(f"Interrupted: {how_far} to go on.") from error
            under_way = False
        finally:
            if created and not report.changes and not under_way:
                await _delete_empty(service, map_id)
    return report, len(frames), list(dict.fromkeys(frame.sequence for frame in frames))


async def _ready_map(
    service: Service, map_id: str, camera: str | None, create: bool, settings: dict[str, str]
) -> tuple[str | None, bool]:
    """Check that the map exists, or create it; the identity of its encoder, and whether it was created.

    Raises:
        Failure: the map does not exist, and is not to be created.
        typer.BadParameter: it is to be created, and could not have the ``camera``.
    """
    created = False
    try:
        found = await service.get(path_of("maps", map_id))
    except Refused as refused:
        if refused.slug != "unknown-map":
            raise
        if not create:
            raise Failure(f"There is no map {map_id!r}. Give --create to create it.") from refused
        if camera is not None:
            raise typer.BadParameter(_without_camera(map_id, camera)) from refused
        found = (await service.request("POST", path_of("maps"), json={"id": map_id, **settings})).json()
        created = True
    encoder = found.get("encoder")
    return None if encoder is None else str(encoder), created


async def _delete_empty(service: Service, map_id: str) -> None:
    """Delete the map that the command has created, unless something is in it; a service that refuses keeps it."""
    with suppress(Failure):
        if (await service.get(path_of("maps", map_id)))["places"] == 0:
            await service.request("DELETE", path_of("maps", map_id))
            remark(f"The map {map_id}, which --create made, is deleted again: no frame became a place of it.")


def _without_camera(map_id: str, camera: str) -> str:
    """Sentences on a map that does not exist yet, and so has no camera."""
    return (
        f"There is no map {map_id!r}, and a map that --create makes has no camera yet. Make both before: "
        f"'placerec maps create {map_id}', then 'placerec maps cameras put {map_id} {camera}', with --mask and "
        "--intrinsics where they are known."
    )


async def _mask(service: Service, map_id: str, camera: str | None, opened: Recording) -> Mask | None:
    """The mask of a camera's frames; a camera that the map does not have is refused, as each frame would be.

    A camera without intrinsics, or without a range of values where frames have 16 bits, gets those of the recording.

    Raises:
        Failure: the map has no such camera.
    """
    from core.frames.masks import Mask, with_range  # here because it takes a moment
    from core.recordings.pictures import range_remark, used_range

    if camera is None:
        if (used := await asyncio.to_thread(used_range, opened.frames)) is not None:
            remark(range_remark(used, None))
        return None
    path = path_of("maps", map_id, "cameras", camera)
    try:
        known = await service.get(path)
    except Refused as refused:
        if refused.slug != "unknown-camera":
            raise
        raise Failure(f"{refused} 'placerec maps cameras put {map_id} {camera}' creates it.") from refused
    found = {name: known.get(name) for name in ("mask", "intrinsics", "value_range")}
    remarks = []
    if found["intrinsics"] is None and opened.intrinsics is not None:
        found["intrinsics"] = opened.intrinsics.model_dump(mode="json")
        remarks.append(f"The camera {camera} had no intrinsics, and has those of the bag now.")
    if found["value_range"] is None and (used := await asyncio.to_thread(used_range, opened.frames)) is not None:
        found["value_range"] = used
        remarks.append(range_remark(used, camera))
    if remarks:
        await service.request("PUT", path, json=found)
    for sentence in remarks:
        remark(sentence)
    areas = None if found["mask"] is None else Mask.model_validate_json(json.dumps(found["mask"]))
    return with_range(areas, found["value_range"])


async def _compare(
    service: Service, map_id: str, frames: Sequence[FrameToSend], wanted: _Wanted, camera: str | None
) -> tuple[frozenset[str], str]:
    """The frames' ids that the map already has, and the name under which to enrol them.

    Raises:
        Refused: the frames' poses are of the kind that the map's are not, for example.
        Failure: places of other frames or other traverses have these ids, and are not to be replaced.
    """
    # Here because it takes a moment.
    from service.places.comparison import MOST_COMPARED, TakenPlace, TraverseComparison, taken_text

    # A name that nobody chose is settled by the first frames that the map has, or else is one that is free.
    name, named, free = wanted.sequence, wanted.named or wanted.replace, wanted.sequence
    more = {"camera": camera, "coordinates": coordinates_of(frame.taken.pose for frame in frames)}

    async def taken_of(items: Sequence[dict[str, str]], settle: bool) -> list[TakenPlace]:
        nonlocal name, named, free
        taken: list[TakenPlace] = []
        for start in range(0, len(items), MOST_COMPARED):
            order = {"places": items[start : start + MOST_COMPARED], "sequence": name, "named": named, **more}
            answer = await service.request("POST", path_of("maps", map_id, "places") + ":compare", json=order)
            told = TraverseComparison.model_validate_json(answer.content)
            taken += told.taken
            free = str(told.free)
            if settle:
                name, named = str(told.sequence), True
        return taken

    by_id = {frame.id: frame for frame in frames if 0 < len(frame.id) <= LONGEST}
    there = [one.id for one in await taken_of([{"id": place_id} for place_id in by_id], settle=False)]
    if wanted.replace:
        return frozenset(there), name
    digests = {place_id: await asyncio.to_thread(_digest, by_id[place_id]) for place_id in there}
    read = [{"id": place_id, "sha256": digest} for place_id, digest in digests.items() if digest is not None]
    taken = await taken_of(read, settle=True)
    if not taken:
        return frozenset(there), name if named else free
    told = taken_text(taken, len(frames))
    of = {one.sequence for one in taken}
    ways = [
        f"--sequence {shlex.quote(free)} --id-prefix {shlex.quote(free + '-')} to enrol them beside",
        "--replace to replace them",
    ]
    if all(one.same for one in taken) and len(of) == 1 and (theirs := of.pop()) is not None:
        ways.insert(0, f"--sequence {shlex.quote(theirs)} to go on with it")
    raise Failure(f"{told} Give {', '.join(ways[:-1])}, or {ways[-1]}.")


def _digest(frame: FrameToSend) -> str | None:
    """The SHA-256 of a frame; None if it cannot be read, which is told where it is sent."""
    try:
        return hashlib.sha256(load(frame)).hexdigest()
    except InvalidFrame:
        return None


def _show(report: Report, map_id: str, sequence: str, frames: int, seconds: float) -> None:
    done = sum(report.changes.values())
    counts = ", ".join(f"{count} {change}" for change, count in sorted(report.changes.items()))
    say(
        f"{done} of {frames} frames are places of {map_id}, sequence {sequence}"
        f"{f': {counts}' if counts else ''}; {report.posed} with a pose; "
        f"{report.uploaded} sent in {seconds:.1f} s."
    )
    refused: dict[str, list[tuple[str, str]]] = {}
    for frame, reason in sorted(report.failures):
        refused.setdefault(re.sub("[0-9]+", "0", reason), []).append((frame, reason))
    for (frame, reason), *more in refused.values():
        complain(f"{frame}: {reason}" if not more else f"{frame} and {len(more)} more frames: {reason}")
