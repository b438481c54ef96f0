"""``placerec enroll``: enrol the images of a directory as places of a map."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.markup import escape

from service.commands.connection.batches import Outcome, enrol_frames
from service.commands.connection.client import DataDir, Refused, Service, Target, Url, open_service, path_of, run
from service.commands.console import Failure, complain, output, progress, remark
from service.commands.jobs import show_outcome, submit
from service.commands.traverse import Frame, read_traverse, unlisted


@dataclass
class Report:
    """The outcomes of the frames so far."""

    changes: Counter[str] = field(default_factory=Counter)
    posed: int = 0
    uploaded: int = 0
    failures: list[tuple[Path, str]] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        """Count one frame."""
        self.uploaded += outcome.uploaded
        if outcome.change is None:
            self.failures.append((outcome.frame.path, str(outcome.refusal)))
        else:
            self.changes[outcome.change] += 1
            self.posed += outcome.posed


def enroll(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Images of one traverse.", show_default=False)],
    map_id: Annotated[str, typer.Option("--map", "-m", help="The map to enrol into.", show_default=False)],
    create: Annotated[bool, typer.Option("--create", help="Create the map if there is none.")] = False,
    encoder: Annotated[
        str | None,
        typer.Option(help="Encoder of a map that is created; for an existing map, the encoder that it must have."),
    ] = None,
    keep: Annotated[
        Literal["none", "thumbnail", "image"] | None,
        typer.Option(help="What a map that is created keeps of each frame."),
    ] = None,
    sequence: Annotated[
        str | None, typer.Option(help="Name of the traverse; default: the name of DIR.", show_default=False)
    ] = None,
    id_prefix: Annotated[str, typer.Option(help="Prefix of the ids that are made from file names.")] = "",
    camera: Annotated[
        str | None, typer.Option(help="Camera of the map that took the images; its mask is applied.")
    ] = None,
    align: Annotated[
        bool, typer.Option("--align", help="Then find which frames show places that the map had already.")
    ] = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Enrol the images of DIR, in natural order, as places of a map.

    Poses come from places.csv in DIR (file,id,x,y,z,heading,latitude,longitude,timestamp; only file is required), or
    else from the EXIF data of the images. Ids are the file names without their extension. The command can be
    interrupted and run again: a frame that is already enrolled is not encoded again.
    """
    frames = [replace(frame, camera=camera) for frame in read_traverse(directory, sequence, id_prefix)]
    left_out = unlisted(directory, frames)
    if left_out:
        remark(f"{left_out} images of {directory} are not listed in places.csv and are left out.")
    began = time.monotonic()
    report = run(_enroll(Target(url, data_dir), map_id, frames, create, {"encoder": encoder, "keep": keep}))
    _show(report, map_id, frames, time.monotonic() - began)
    if align:
        body = {"sequence": frames[0].sequence}
        _show_aligned(submit(Target(url, data_dir), path_of("maps", map_id, "align"), body, wait=True))
    if report.failures:
        raise typer.Exit(1)


def _show_aligned(job: dict[str, Any]) -> None:
    """Say what the job has found.

    Raises:
        Failure: it has failed or was cancelled.
    """
    if job["state"] != "succeeded":
        show_outcome(job, as_json=False)
        return
    found = job["result"]
    told = ", ".join(f"{one['sequence']}: {one['paired']}" for one in found["traverses"] if one["paired"])
    output.print(
        f"{found['paired']} of {found['frames']} frames show places of other traverses{f' ({told})' if told else ''}; "
        f"{found['poses_handed_over']} poses were handed over.",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )


async def _enroll(
    target: Target, map_id: str, frames: Sequence[Frame], create: bool, wanted: dict[str, str | None]
) -> Report:
    report = Report()
    async with open_service(target) as service:
        await _ready_map(service, map_id, create, {key: value for key, value in wanted.items() if value is not None})
        if (camera := frames[0].camera) is not None:
            await service.get(path_of("maps", map_id, "cameras", camera))  # otherwise each frame would be refused
        known = await _check_ids(service, map_id, frames)
        with progress() as bar:
            task = bar.add_task(f"Enrolling into {escape(map_id)}", total=len(frames))

            def tell(outcome: Outcome) -> None:
                report.add(outcome)
                bar.advance(task)

            try:
                await enrol_frames(service, map_id, frames, known, wanted["encoder"], tell)
            except Failure as failure:
                done = sum(report.changes.values())
                raise Failure(
                    f"{failure} {done} of {len(frames)} frames are enrolled; run the command again to continue."
                ) from failure
    return report


async def _ready_map(service: Service, map_id: str, create: bool, settings: dict[str, str]) -> None:
    """Check that the map exists, or create it."""
    try:
        await service.get(path_of("maps", map_id))
    except Refused as refused:
        if refused.slug != "unknown-map":
            raise
        if not create:
            raise Failure(f"There is no map {map_id!r}. Give --create to create it.") from refused
        await service.request("POST", path_of("maps"), json={"id": map_id, **settings})


async def _check_ids(service: Service, map_id: str, frames: Sequence[Frame]) -> frozenset[str]:
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


def _show(report: Report, map_id: str, frames: Sequence[Frame], seconds: float) -> None:
    done = sum(report.changes.values())
    counts = ", ".join(f"{count} {change}" for change, count in sorted(report.changes.items()))
    output.print(
        f"{done} of {len(frames)} frames are places of {map_id}, sequence {frames[0].sequence}"
        f"{f': {counts}' if counts else ''}; {report.posed} with a pose; "
        f"{report.uploaded} sent in {seconds:.1f} s.",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    for path, reason in sorted(report.failures):
        complain(f"{path.name}: {reason}")
