"""``placerec enroll``: the frames of a directory become places of a map."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.markup import escape

from service.commands.client import (
    DataDir,
    Refused,
    Service,
    Target,
    Url,
    media_type,
    open_service,
    path_of,
    run,
)
from service.commands.console import Failure, complain, output, progress, remark
from service.commands.manifest import Frame, read_traverse, unlisted

PATIENCE = 120.0
"""Seconds for which a frame is sent again while the service is overloaded or restarts."""

OF_THE_FRAME = frozenset({400, 413, 415, 422})
"""Statuses that concern one frame; with any other the rest would most likely fail as well."""


@dataclass
class Report:
    """What became of the frames so far."""

    changes: Counter[str] = field(default_factory=Counter)
    posed: int = 0
    failures: list[tuple[Path, str]] = field(default_factory=list)


def enroll(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Images of one traverse.", show_default=False)],
    map_id: Annotated[str, typer.Option("--map", "-m", help="The map to enrol into.", show_default=False)],
    create: Annotated[bool, typer.Option("--create", help="Create the map if there is none.")] = False,
    encoder: Annotated[
        str | None, typer.Option(help="Encoder of the map: of the one that is created, or as a check.")
    ] = None,
    keep: Annotated[
        Literal["none", "thumbnail", "image"] | None, typer.Option(help="What a map that is created keeps of a frame.")
    ] = None,
    sequence: Annotated[
        str | None, typer.Option(help="Name of the traverse; default: the directory's name.", show_default=False)
    ] = None,
    id_prefix: Annotated[str, typer.Option(help="Put before the ids made of file names.")] = "",
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Enrol the images of DIR, in natural order, as places of a map.

    Poses come from places.csv in DIR (file,id,x,y,z,heading,latitude,longitude,timestamp; only file is needed), or
    else from the images' EXIF data. Ids are the files' names without their ending. It can be broken off and run
    again: a frame whose bytes are known is not encoded again.
    """
    frames = read_traverse(directory, sequence, id_prefix)
    left_out = unlisted(directory, frames)
    if left_out:
        remark(f"{left_out} images of {directory} are not in places.csv and are left out.")
    began = time.monotonic()
    report = run(_enroll(Target(url, data_dir), map_id, frames, create, {"encoder": encoder, "keep": keep}))
    _show(report, map_id, frames, time.monotonic() - began)
    if report.failures:
        raise typer.Exit(1)


async def _enroll(
    target: Target, map_id: str, frames: Sequence[Frame], create: bool, wanted: dict[str, str | None]
) -> Report:
    report = Report()
    async with open_service(target) as service:
        await _ready_map(service, map_id, create, {key: value for key, value in wanted.items() if value is not None})
        await _check_ids(service, map_id, frames)
        with progress() as bar:
            # One after the other: the order of enrolment is the order of the frames in their sequence.
            for frame in bar.track(frames, description=f"Enrolling into {escape(map_id)}"):
                try:
                    await _send(service, map_id, frame, wanted["encoder"], report)
                except Failure as failure:
                    done = sum(report.changes.values())
                    raise Failure(
                        f"{failure} {done} of {len(frames)} frames are enrolled; the same command goes on from there."
                    ) from failure
    return report


async def _ready_map(service: Service, map_id: str, create: bool, settings: dict[str, str]) -> None:
    """See that the map is there, or create it."""
    try:
        await service.get(path_of("maps", map_id))
    except Refused as refused:
        if refused.slug != "unknown-map":
            raise
        if not create:
            raise Failure(f"There is no map {map_id!r}; --create makes it.") from refused
        await service.request("POST", path_of("maps"), json={"id": map_id, **settings})


async def _check_ids(service: Service, map_id: str, frames: Sequence[Frame]) -> None:
    """Refuse to overwrite the places of another traverse whose files have the same names."""
    known: dict[str, Any] = {}
    async for page in service.pages(path_of("maps", map_id, "places")):
        known.update({place["id"]: place["sequence"] for place in page["items"]})
    taken = [frame for frame in frames if frame.id in known and known[frame.id] != frame.sequence]
    if taken:
        other = known[taken[0].id]
        raise Failure(
            f"{len(taken)} ids of this traverse are taken by places of another one ({taken[0].id!r} is of "
            f"{'no sequence' if other is None else repr(other)}). Give --id-prefix, for instance "
            f"--id-prefix {taken[0].sequence}-, or the right --sequence."
        )


async def _send(service: Service, map_id: str, frame: Frame, encoder: str | None, report: Report) -> None:
    try:
        data = await asyncio.to_thread(frame.path.read_bytes)
        parameters = frame.parameters(data)
        answer = await service.request(
            "PUT",
            path_of("maps", map_id, "places", frame.id),
            params=parameters if encoder is None else {**parameters, "encoder": encoder},
            content=data,
            headers={"Content-Type": media_type(data)},
            patience=PATIENCE,
        )
    except Refused as refused:
        if refused.status not in OF_THE_FRAME and refused.slug != "internal-error":
            raise
        report.failures.append((frame.path, str(refused)))
    except OSError as error:
        report.failures.append((frame.path, f"it cannot be read: {error.strerror}."))
    else:
        report.changes[answer.json()["change"]] += 1
        report.posed += len(parameters.keys() & {"x", "latitude"})


def _show(report: Report, map_id: str, frames: Sequence[Frame], seconds: float) -> None:
    done = sum(report.changes.values())
    counts = ", ".join(f"{count} {change}" for change, count in sorted(report.changes.items()))
    output.print(
        f"{done} of {len(frames)} frames are places of {map_id}, sequence {frames[0].sequence}"
        f"{f': {counts}' if counts else ''}; {report.posed} with a pose; {seconds:.1f} s.",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    for path, reason in sorted(report.failures):
        complain(f"{path.name}: {reason}")
