"""``placerec query``: recognize the places where frames were taken."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from core.errors import InvalidImage, InvalidRecording
from service.commands.connection.client import (
    CommandTarget,
    DataDir,
    Refused,
    Service,
    Url,
    media_type,
    open_service,
    path_of,
    run,
)
from service.commands.console import Failure, complain, json_text, number, show, table
from service.commands.options.recordings import (
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
)

if TYPE_CHECKING:
    from core.recordings import RecordedFrame

QueryFrame = tuple[str, "RecordedFrame", bool]
"""The file of a frame as it was given, the frame, and whether it is one of a recording."""

PATIENCE = 30.0
"""Seconds for which a frame is repeated while the service is overloaded."""


def query(
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGE…",
            help="Frames to localize: images, and directories of images, bags or videos.",
            show_default=False,
        ),
    ],
    map_id: Annotated[str, typer.Option("--map", "-m", help="The map to search.", show_default=False)],
    k: Annotated[int, typer.Option("-k", min=1, max=100, help="How many matches to return.")] = 5,
    near: Annotated[
        str | None,
        typer.Option(help="Search only within --radius of X,Y in metres, or LATITUDE,LONGITUDE with --geographic."),
    ] = None,
    radius: Annotated[float | None, typer.Option(min=0, help="Metres around --near.")] = None,
    geographic: Annotated[bool, typer.Option("--geographic", help="Read --near as degrees.")] = False,
    bbox: Annotated[str | None, typer.Option(help="Search only in WEST,SOUTH,EAST,NORTH, in degrees.")] = None,
    sequences: Annotated[str | None, typer.Option(help="Search only in these traverses, separated by commas.")] = None,
    after: Annotated[str | None, typer.Option(help="Search only places of this time or later.")] = None,
    before: Annotated[str | None, typer.Option(help="Search only places of this time or earlier.")] = None,
    where: Annotated[
        str | None, typer.Option(help="Search only places whose metadata has the values of this JSON object.")
    ] = None,
    soft: Annotated[
        str | None,
        typer.Option(
            help="Use these as priors, not as filters: position, bbox, sequences, time, where, separated by commas."
        ),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="Camera of the map that took the images; its mask is applied.")
    ] = None,
    verify: Annotated[
        Literal["auto", "always", "never"],
        typer.Option(help="Compare keypoints with the best candidates; auto: where the scores leave doubt."),
    ] = "auto",
    topic: Topic = None,
    pose_topic: PoseTopic = None,
    fixed_frame: FixedFrame = None,
    moving_frame: MovingFrame = None,
    trajectory: TrajectoryFile = None,
    trajectory_times: TrajectoryTimes = None,
    largest_gap: LargestGap = None,
    most_speed: MostSpeed = None,
    every_metres: EveryMetres = None,
    every_degrees: EveryDegrees = None,
    every_seconds: EverySeconds = None,
    every_change: EveryChange = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: Annotated[bool, typer.Option("--json", help="Write one JSON object a line for each frame.")] = False,
) -> None:
    """Recognize the place of a map that each frame shows, if any.

    Of a recording the poses serve only to choose keyframes; they are not sent.

    An unknown place is an answer, not an error: the exit status is 1 only if an image cannot be used.
    """
    known: dict[str, Any] = {
        "bbox": bbox,
        "sequences": sequences,
        "after": after,
        "before": before,
        "where": where,
        "soft": soft,
        "camera": camera,
    }
    known |= {"radius": radius, **_position(near, geographic)}
    parameters = {"k": k, "verify": verify, **{name: value for name, value in known.items() if value is not None}}
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

    def frames(encoder: str | None) -> Iterator[QueryFrame]:
        return _frames(images, options, encoder)

    failures = run(
        _query(CommandTarget(url, data_dir), map_id, frames, options.every_change is not None, parameters, as_json)
    )
    if failures:
        raise typer.Exit(1)


def _position(near: str | None, geographic: bool) -> dict[str, Any]:
    if near is None:
        return {}
    parts = near.split(",")
    if len(parts) != 2:
        raise Failure(f"--near {near} is not two numbers with a comma between them.")
    return dict(zip(("latitude", "longitude") if geographic else ("x", "y"), parts, strict=True))


def _frames(images: list[Path], options: RecordingOptions, encoder: str | None) -> Iterator[QueryFrame]:
    """The frames of all that was given, in its order."""
    from core.recordings.folder import picture_frame
    from core.recordings.recording import is_recording

    for path in images:
        if is_recording(path):
            with options.open(path) as recording:
                for frame in options.choose(recording, encoder):
                    yield str(path), frame, True
        else:
            yield str(path), picture_frame(path), False


async def _query(
    target: CommandTarget,
    map_id: str,
    frames: Callable[[str | None], Iterator[QueryFrame]],
    by_change: bool,
    parameters: dict[str, Any],
    as_json: bool,
) -> int:
    failures = 0
    rows = table(
        "image", "verdict", "place", "#probability", "#score", "#margin", "best match", "#ms", title=f"Map {map_id}"
    )
    async with open_service(target) as service:
        encoder = (await service.get(path_of("maps", map_id)))["encoder"] if by_change else None
        for file, frame, of_recording in frames(encoder):
            try:
                data = await asyncio.to_thread(_load, file, frame)
                answer = await _ask(service, map_id, data, parameters)
            except (Refused, InvalidImage, InvalidRecording) as error:
                if isinstance(error, Refused) and error.status not in (400, 413, 415, 422):
                    raise
                failures += 1
                complain(f"{frame.name}: {error}")
                continue
            if as_json:
                line = {"file": file, **({"frame": frame.id} if of_recording else {}), **answer}
                typer.echo(json_text(line))
            else:
                rows.add_row(frame.name, *_cells(answer))
    if rows.row_count:
        show(rows)
    return failures


def _load(file: str, frame: RecordedFrame) -> bytes:
    try:
        return frame.load()
    except OSError as error:
        raise Failure(f"{file} cannot be read: {error.strerror}.") from error


async def _ask(service: Service, map_id: str, data: bytes, parameters: dict[str, Any]) -> dict[str, Any]:
    response = await service.request(
        "POST",
        path_of("maps", map_id, "query"),
        params=parameters,
        content=data,
        headers={"Content-Type": media_type(data)},
        patience=PATIENCE,
    )
    answer: dict[str, Any] = response.json()
    return answer


def _cells(answer: dict[str, Any]) -> list[str]:
    matches = answer["matches"]
    reason = f" ({answer['reason']})" if answer["reason"] else ""  # such as no-place-allowed, of a mistyped traverse
    return [
        answer["verdict"] + reason,
        answer["place"]["id"] if answer["place"] else "–",
        number(answer["probability"]),
        number(answer["score"]),
        number(answer["margin"]),
        matches[0]["place"]["id"] if matches else "–",
        number(answer["milliseconds"]["total"], 1),
    ]
