"""``placerec maps places`` and ``placerec maps sequences``: the places and the traverses of a map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from core.disk.permissions import open_private
from service.commands.connection.client import (
    AsJson,
    CommandTarget,
    DataDir,
    MapId,
    Url,
    ask,
    list_items,
    open_service,
    path_of,
    run,
)
from service.commands.console import Commands, Failure, remark, show, show_json, table
from service.commands.jobs import followed, submit

places = typer.Typer(cls=Commands, help="List, show, edit and delete the places of a map.", no_args_is_help=True)

Erase = Annotated[bool, typer.Option("--erase", help="Also erase what is left of them, and discard frames for review.")]
PlaceId = Annotated[str, typer.Argument(metavar="PLACE", help="The place's id.", show_default=False)]
CLEARED = ("pose", "pose_accuracy", "timestamp", "sequence", "level", "metadata")
COORDINATES = ("x", "y", "z", "latitude", "longitude", "heading")


@places.command("list")
def list_places(
    map_id: MapId,
    sequence: Annotated[str | None, typer.Option(help="Only the places of this traverse.")] = None,
    level: Annotated[str | None, typer.Option(help="Only the places on this storey.")] = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """List a map's places in the order of their enrolment."""
    params = {name: value for name, value in (("sequence", sequence), ("level", level)) if value is not None} or None
    found = list_items(CommandTarget(url, data_dir), path_of("maps", map_id, "places"), params)
    if as_json:
        show_json(found)
        return
    shown = table("place", "sequence", "pose", "timestamp", "#regions")
    for place in found:
        shown.add_row(*_cells(place))
    show(shown)


@places.command("show")
def show_place(
    map_id: MapId, place_id: PlaceId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False
) -> None:
    """Show one place."""
    _show_place(ask(CommandTarget(url, data_dir), "GET", path_of("maps", map_id, "places", place_id)).json(), as_json)


@places.command("edit")
def edit_place(
    map_id: MapId,
    place_id: PlaceId,
    x: Annotated[float | None, typer.Option(help="Metres.")] = None,
    y: Annotated[float | None, typer.Option(help="Metres.")] = None,
    z: Annotated[float | None, typer.Option(help="Metres.")] = None,
    latitude: Annotated[float | None, typer.Option(help="Degrees, WGS 84.")] = None,
    longitude: Annotated[float | None, typer.Option(help="Degrees, WGS 84.")] = None,
    heading: Annotated[float | None, typer.Option(help="Degrees.")] = None,
    timestamp: Annotated[str | None, typer.Option(help="ISO 8601.")] = None,
    sequence: Annotated[str | None, typer.Option(help="Name of the traverse.")] = None,
    level: Annotated[str | None, typer.Option(help="The storey on which it is.")] = None,
    metadata: Annotated[str | None, typer.Option(metavar="JSON", help="Merged into the metadata of the place.")] = None,
    clear: Annotated[
        list[str] | None,
        typer.Option(help=f"Clear this field first: {', '.join(CLEARED)}; may be repeated."),
    ] = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Change fields of a place; the others stay as they are."""
    cleared = dict.fromkeys(clear or [])
    if unknown := set(cleared) - set(CLEARED):
        raise typer.BadParameter(f"--clear: unknown field {', '.join(sorted(unknown))}")
    pose = dict(zip(COORDINATES, (x, y, z, latitude, longitude, heading), strict=True))
    given: dict[str, Any] = {"timestamp": timestamp, "sequence": sequence, "level": level}
    given = {name: value for name, value in given.items() if value is not None}
    if any(value is not None for value in pose.values()):
        # With --clear pose the new pose may be in another frame of reference.
        given_pose = {name: value for name, value in pose.items() if value is not None}
        given["pose"] = dict.fromkeys(COORDINATES) | given_pose if "pose" in cleared else given_pose
    if metadata is not None:
        given["metadata"] = _object(metadata)
    changes = {**cleared, **given}
    if not changes:
        raise typer.BadParameter("give at least one field to change")
    path = path_of("maps", map_id, "places", place_id)
    _show_place(ask(CommandTarget(url, data_dir), "PATCH", path, json=changes).json(), as_json)


@places.command("delete")
def delete_places(
    map_id: MapId,
    place_ids: Annotated[list[str], typer.Argument(metavar="PLACE…", help="Ids.", show_default=False)],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    erase: Erase = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Delete places: all of them, or none if the map lacks one. This cannot be undone."""
    for place_id in place_ids:
        path_of(place_id)  # refuses an invalid name before the request
    path = path_of("maps", map_id, "places") + ":delete"
    erasing = path_of("maps", map_id, "erase")

    async def work() -> None:
        async with open_service(CommandTarget(url, data_dir)) as service:

            async def order(dry_run: bool) -> Any:
                return (await service.request("POST", path, json={"ids": place_ids, "dry_run": dry_run})).json()

            if missing := (await order(dry_run=True))["missing"]:
                raise Failure(f"The map {map_id} has no place {', '.join(missing)}; nothing was deleted.")
            if not yes:
                typer.confirm(f"Delete from the map {map_id}: {', '.join(place_ids)}?", abort=True)
            if erase:
                submitted = await service.request("POST", erasing, json={"ids": place_ids})
                show_erased(await followed(service, submitted.json()))
                return
            deleted = await order(dry_run=False)
            if deleted["ids"]:
                remark(f"Deleted: {', '.join(deleted['ids'])}.")
            if deleted["missing"]:
                raise Failure(f"Meanwhile somebody else deleted {', '.join(deleted['missing'])}.")

    run(work())


@places.command("thumbnail")
def save_thumbnail(
    map_id: MapId,
    place_id: PlaceId,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="JPEG file to write.", show_default=False)],
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Save the picture that the map keeps of a place."""
    picture = ask(CommandTarget(url, data_dir), "GET", path_of("maps", map_id, "places", place_id, "thumbnail")).content
    try:
        with open(file, "wb", opener=open_private) as opened:
            opened.write(picture)
    except OSError as error:
        raise Failure(f"{file} cannot be written: {error.strerror}.") from error


def show_erased(job: dict[str, Any], ordered: bool = True) -> None:
    """Say what a job has erased.

    Args:
        ordered: whether something was named, and not only what deleted places have left.

    Raises:
        Failure: it did not succeed.
    """
    if job["state"] != "succeeded":
        reason = (job["problem"] or {}).get("detail", "")
        raise Failure(f"Erasing {job['state']}: {reason} What is deleted stays so; erase it again.")
    found = job["result"]
    remark(
        f"Erased: {found['places']} places, {found['looks']} looks, {found['review']} frames for review, "
        f"{found['answers']} answers; what {found['rows']} frames had left is gone."
        + (f" Bags removed: {found['bags']}." if found["bags"] else "")
    )
    if ordered and not any(found[kind] for kind in ("places", "looks", "review", "answers", "bags")):
        remark("The map has nothing of what was named: is a name mistyped?")
    if waiting := found["waiting_bags"]:
        named = ", ".join(waiting[:10]) + (", …" if len(waiting) > 10 else "")
        remark(
            f"Bags that wait to be enrolled, which may have such frames: {named}. placerec maps erase --bags removes "
            "them, but for those in use."
        )


def _object(text: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except ValueError as error:
        raise Failure(f"--metadata is not valid JSON: {error}.") from error
    if not isinstance(value, dict):
        raise Failure("--metadata is not a JSON object.")
    return value


def _cells(place: dict[str, Any]) -> list[str]:
    pose = place["pose"] or {}
    shown_pose = " ".join(f"{name}={value:g}" for name, value in pose.items() if value is not None)
    return [
        place["id"],
        place["sequence"] or "–",
        shown_pose or "–",
        place["timestamp"] or "–",
        str(place["regions"]),
    ]


def _show_place(place: dict[str, Any], as_json: bool) -> None:
    if as_json:
        show_json(place)
        return
    shown = table("field", "value", title=f"Place {place['id']}")
    _, sequence, pose, timestamp, regions = _cells(place)
    shown.add_row("sequence", sequence)
    shown.add_row("camera", place["camera"] or "–")
    shown.add_row("level", place["level"] or "–")
    for name, value in {"pose": pose, "timestamp": timestamp, "regions": regions}.items():
        shown.add_row(name, value)
    for name in ("metadata", "picture", "created_at", "updated_at"):
        shown.add_row(name, json.dumps(place[name], ensure_ascii=False) if name == "metadata" else str(place[name]))
    show(shown)


sequences = typer.Typer(cls=Commands, help="List and delete the traverses of a map.", no_args_is_help=True)


@sequences.command("list")
def list_sequences(map_id: MapId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List the traverses of a map."""
    found = list_items(CommandTarget(url, data_dir), path_of("maps", map_id, "sequences"))
    if as_json:
        show_json(found)
        return
    shown = table("sequence", "#places", "first", "last")
    for item in found:
        shown.add_row(item["name"] or "–", str(item["places"]), item.get("first_at") or "–", item.get("last_at") or "–")
    show(shown)


@sequences.command("delete")
def delete_sequence(
    map_id: MapId,
    sequence: Annotated[str, typer.Argument(metavar="SEQUENCE", help="Name of the traverse.", show_default=False)],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    erase: Erase = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Delete all places of a traverse. This cannot be undone."""
    path = path_of("maps", map_id, "sequences", sequence)
    target = CommandTarget(url, data_dir)
    if erase and sequence not in (item["name"] for item in list_items(target, path_of("maps", map_id, "sequences"))):
        raise Failure(f"The map {map_id} has no sequence {sequence}; nothing was deleted.")
    if not yes:
        typer.confirm(f"Delete all places of the sequence {sequence} of the map {map_id}?", abort=True)
    if erase:
        order = {"filter": {"sequence": sequence}}
        show_erased(submit(target, path_of("maps", map_id, "erase"), order, wait=True))
        return
    deleted = ask(target, "DELETE", path).json()
    remark(f"The sequence {sequence} is deleted: {deleted['places']} places.")
