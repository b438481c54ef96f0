"""``placerec maps cameras``: the cameras of a map, with what is ignored in their frames and their intrinsics."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from service.commands.connection.client import (
    AsJson,
    CommandTarget,
    DataDir,
    MapId,
    Refused,
    Url,
    ask,
    open_service,
    path_of,
    read_bytes,
    run,
)
from service.commands.console import Commands, Failure, remark, show, show_json, table

cameras = typer.Typer(
    cls=Commands, help="List, show, make, change and delete the cameras of a map.", no_args_is_help=True
)

CameraName = Annotated[
    str, typer.Argument(metavar="NAME", help="The name that frames give with --camera.", show_default=False)
]
STANDARD_INPUT = Path("-")


@cameras.command("list")
def list_cameras(map_id: MapId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List the cameras of a map."""
    found = ask(CommandTarget(url, data_dir), "GET", path_of("maps", map_id, "cameras")).json()["items"]
    if as_json:
        show_json(found)
        return
    shown = table("camera", "mask", "intrinsics", "values", "updated_at")
    for camera in found:
        lens, values = _lens(camera["intrinsics"]), _values(camera["value_range"])
        shown.add_row(camera["name"], _area(camera["mask"]), lens, values, camera["updated_at"])
    show(shown)


@cameras.command("show")
def show_camera(
    map_id: MapId, name: CameraName, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False
) -> None:
    """Show one camera: the corners of its mask, and its intrinsics."""
    path = path_of("maps", map_id, "cameras", name)
    _show_camera(ask(CommandTarget(url, data_dir), "GET", path).json(), as_json)


@cameras.command("put")
def put_camera(
    map_id: MapId,
    name: CameraName,
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON: width, height, fx, fy, cx, cy, distortion_model and distortion, as in ROS's CameraInfo.",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON: polygons, each by its corners, which are shares of width and height from the top left.",
        ),
    ] = None,
    depth_bits: Annotated[
        int | None,
        typer.Option(min=1, max=16, help="Bits that the camera uses of frames of 16 bits: 10 are values 0 to 1023."),
    ] = None,
    value_range: Annotated[
        tuple[int, int] | None,
        typer.Option(
            metavar="LOW HIGH",
            help="Values of frames of 16 bits that become black and white, as of a thermal camera.",
            show_default=False,
        ),
    ] = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Create a camera, or change its mask, its intrinsics or its values; what is not given stays as it is.

    Without options a new camera is only a name. FILE is JSON as the HTTP interface takes it; - reads standard
    input, and a file with null removes what the camera has.
    """
    if intrinsics == mask == STANDARD_INPUT:
        raise typer.BadParameter("--intrinsics and --mask cannot both be read from standard input")
    if depth_bits is not None and value_range is not None:
        raise typer.BadParameter("--depth-bits is a --value-range from 0 on; give one of them")
    files = {"mask": mask, "intrinsics": intrinsics}
    changes = {field: _read_json(file) for field, file in files.items() if file is not None}
    if depth_bits is not None:
        changes["value_range"] = [0, 2**depth_bits - 1]
    if value_range is not None:
        changes["value_range"] = list(value_range)
    _show_camera(run(_put(CommandTarget(url, data_dir), path_of("maps", map_id, "cameras", name), changes)), as_json)


@cameras.command("delete")
def delete_camera(
    map_id: MapId,
    name: CameraName,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Delete a camera. Frames that name it are refused from then on; places that were enrolled with it stay."""
    path = path_of("maps", map_id, "cameras", name)
    if not yes:
        typer.confirm(f"Delete the camera {name} of the map {map_id}?", abort=True)
    ask(CommandTarget(url, data_dir), "DELETE", path)
    remark(f"The camera {name} of the map {map_id} is deleted.")


async def _put(target: CommandTarget, path: str, changes: dict[str, Any]) -> dict[str, Any]:
    """Create the camera at ``path``, or change these fields of it; the camera as it is then."""
    async with open_service(target) as service:
        before = {"mask": None, "intrinsics": None, "value_range": None}
        try:
            found = await service.get(path)
        except Refused as refused:
            if refused.slug != "unknown-camera":
                raise
        else:
            before = {field: found[field] for field in before}
        made: dict[str, Any] = (await service.request("PUT", path, json=before | changes)).json()
        return made


def _read_json(file: Path) -> Any:
    """The value of a JSON file, or of standard input.

    Raises:
        Failure: it cannot be read or is not JSON.
    """
    text = sys.stdin.buffer.read() if file == STANDARD_INPUT else read_bytes(file)
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        source = "Standard input" if file == STANDARD_INPUT else file
        raise Failure(f"{source} is not valid JSON: {error}.") from error


def _refuse_constant(name: str) -> NoReturn:
    """Refuse ``NaN`` and ``Infinity``, which Python alone takes for JSON.

    Raises:
        ValueError: always.
    """
    raise ValueError(f"{name} is no number")


def _area(mask: dict[str, Any] | None) -> str:
    """How much a mask has, in one cell."""
    if mask is None:
        return "–"
    count = len(mask["polygons"])
    return f"{count} polygon{'' if count == 1 else 's'}"


def _lens(intrinsics: dict[str, Any] | None) -> str:
    """The size of the frames and the kind of distortion, in one cell."""
    if intrinsics is None:
        return "–"
    return f"{intrinsics['width']} x {intrinsics['height']}, distortion {intrinsics['distortion_model']}"


def _values(value_range: list[int] | None) -> str:
    """The range of values of frames of 16 bits, in one cell."""
    return "–" if value_range is None else f"{value_range[0]} to {value_range[1]}"


def _show_camera(camera: dict[str, Any], as_json: bool) -> None:
    if as_json:
        show_json(camera)
        return
    shown = table("field", "value", title=f"Camera {camera['name']}")
    shown.add_row("mask", _area(camera["mask"]))
    for number, corners in enumerate((camera["mask"] or {"polygons": []})["polygons"], 1):
        shown.add_row(f"polygon {number}", " ".join(f"({x:g}, {y:g})" for x, y in corners))
    if camera["intrinsics"] is None:
        shown.add_row("intrinsics", "–")
    for field, value in (camera["intrinsics"] or {}).items():
        # Not rounded, for they may be copied from here.
        shown.add_row(field, ", ".join(map(str, value)) or "–" if isinstance(value, list) else str(value))
    shown.add_row("values", _values(camera["value_range"]))
    shown.add_row("updated_at", camera["updated_at"])
    show(shown)
