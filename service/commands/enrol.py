"""``placerec enrol``: enrol the frames of a recording as places of a map."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from core.errors import InvalidIdentifier
from core.places import check_sequence
from service.commands.connection.batches import FrameToSend, SendingOutcome, enrol_frames
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
    PoseTopic,
    RecordingOptions,
    Topic,
    TrajectoryFile,
    TrajectoryTimes,
    without_stops,
)

if TYPE_CHECKING:
    from core.frames.intrinsics import Intrinsics
    from core.frames.masks import Mask


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
        str | None, typer.Option(help="Name of the traverse; default: the name of RECORDING.", show_default=False)
    ] = None,
    id_prefix: Annotated[str, typer.Option(help="Prefix of the ids that are made from names of files or topics.")] = "",
    camera: Annotated[
        str | None, typer.Option(help="Camera of the map that took the images; its mask is applied.")
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
    (file,id,x,y,z,heading,latitude,longitude,timestamp; only file is required), or else from the EXIF data of the
    images; ids are the file names without their extension. The frames of a bag are taken in the order of their header
    stamps, of which their ids are made; those of a video are numbered. Of both, frames that show what the one before
    shows, as where the robot stood, are left out. A frame that is neither JPEG nor PNG nor WebP is sent as PNG.
    The command can be interrupted and run again: a frame that is already enrolled is not sent again.
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
    )
    target = CommandTarget(url, data_dir)
    began = time.monotonic()
    with options.open(recording, id_prefix) as opened:
        from core.recordings.paths import check_lost_poses, traverse_of, way_of  # here because it takes a moment

        name = opened.name if sequence is None else sequence
        for one in {traverse_of(name, frame) for frame in opened.frames}:
            _checked_sequence(one)
        traverses = dict[str, None]()  # of the chosen frames, in their order
        if not allow_lost_poses:
            check_lost_poses(opened, remarked=True)

        def choose(used: str | None, mask: Mask | None) -> list[FrameToSend]:
            chosen = options.choose(opened, used, mask)
            chosen = chosen if keep_standing else without_stops(opened, chosen, mask)
            if (way := way_of(chosen)) is not None:
                remark(f"{way[0].upper()}{way[1:]}.")
            to_send = [FrameToSend(taken, traverse_of(name, taken), camera) for taken in chosen]
            traverses.update(dict.fromkeys(one.sequence for one in to_send))
            return to_send

        report, frames = run(
            _enrol(target, map_id, choose, camera, create, {"encoder": encoder, "keep": keep}, opened.intrinsics)
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
    camera: str | None,
    create: bool,
    wanted: dict[str, str | None],
    intrinsics: Intrinsics | None,
) -> tuple[Report, int]:
    """Enrol the frames that ``choose`` gives for the map's encoder and the camera's mask.

    Returns:
        The outcome, and the number of frames.
    """
    report = Report()
    async with open_service(target) as service:
        given = {key: value for key, value in wanted.items() if value is not None}
        used = await _ready_map(service, map_id, camera, create, given)
        mask = None if camera is None else await _mask(service, map_id, camera, intrinsics)
        frames = await asyncio.to_thread(choose, used, mask)
        known = await _check_ids(service, map_id, frames)
        with progress() as bar:
            task = bar.add_task(f"Enrolling into {map_id}", total=len(frames))

            def report_frame(outcome: SendingOutcome) -> None:
                report.add(outcome)
                bar.advance(task)

            try:
                await enrol_frames(service, map_id, frames, known, wanted["encoder"], report_frame)
            except Failure as failure:
                done = sum(report.changes.values())
                raise Failure(
                    f"{failure} {done} of {len(frames)} frames are enrolled; run the command again to continue."
                ) from failure
    return report, len(frames)


async def _ready_map(
    service: Service, map_id: str, camera: str | None, create: bool, settings: dict[str, str]
) -> str | None:
    """Check that the map exists, or create it; the identity of its encoder.

    Raises:
        Failure: the map does not exist, and is not to be created.
        typer.BadParameter: it is to be created, and could not have the ``camera``.
    """
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
    encoder = found.get("encoder")
    return None if encoder is None else str(encoder)


def _without_camera(map_id: str, camera: str) -> str:
    """Sentences on a map that does not exist yet, and so has no camera."""
    return (
        f"There is no map {map_id!r}, and a map that --create makes has no camera yet. Make both before: "
        f"'placerec maps create {map_id}', then 'placerec maps cameras put {map_id} {camera}', with --mask and "
        "--intrinsics where they are known."
    )


async def _mask(service: Service, map_id: str, camera: str, intrinsics: Intrinsics | None) -> Mask | None:
    """The mask of a camera's frames; a camera that the map does not have is refused, as each frame would be.

    A camera without intrinsics gets those of the recording.

    Raises:
        Failure: the map has no such camera.
    """
    from core.frames.masks import Mask  # here because it takes a moment

    path = path_of("maps", map_id, "cameras", camera)
    try:
        known = await service.get(path)
    except Refused as refused:
        if refused.slug != "unknown-camera":
            raise
        raise Failure(f"{refused} 'placerec maps cameras put {map_id} {camera}' creates it.") from refused
    found = known["mask"]
    if intrinsics is not None and known["intrinsics"] is None:
        await service.request("PUT", path, json={"mask": found, "intrinsics": intrinsics.model_dump(mode="json")})
        remark(f"The camera {camera} had no intrinsics, and has those of the bag now.")
    return None if found is None else Mask.model_validate_json(json.dumps(found))


async def _check_ids(service: Service, map_id: str, frames: Sequence[FrameToSend]) -> frozenset[str]:
    """The frames' ids that the map already has; those of another traverse are refused, not overwritten."""
    wanted = {frame.id for frame in frames}
    known: dict[str, Any] = {}
    async for page in service.pages(path_of("maps", map_id, "places")):
        known.update({place["id"]: place["sequence"] for place in page["items"] if place["id"] in wanted})
    taken = [frame for frame in frames if frame.id in known and known[frame.id] != frame.sequence]
    if taken:
        other = known[taken[0].id]
        raise Failure(
            f"{len(taken)} ids of this traverse belong to places of another one ({taken[0].id!r} is in "
            f"{'no sequence' if other is None else repr(other)}). Give --id-prefix, for instance "
            f"--id-prefix {taken[0].sequence}-, or the right --sequence."
        )
    return frozenset(known)


def _show(report: Report, map_id: str, sequence: str, frames: int, seconds: float) -> None:
    done = sum(report.changes.values())
    counts = ", ".join(f"{count} {change}" for change, count in sorted(report.changes.items()))
    say(
        f"{done} of {frames} frames are places of {map_id}, sequence {sequence}"
        f"{f': {counts}' if counts else ''}; {report.posed} with a pose; "
        f"{report.uploaded} sent in {seconds:.1f} s."
    )
    for frame, reason in sorted(report.failures):
        complain(f"{frame}: {reason}")
