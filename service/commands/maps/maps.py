"""``placerec maps``: create, look after and delete maps."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import typer

from service.commands.connection.client import (
    AsJson,
    CommandTarget,
    DataDir,
    MapId,
    Url,
    ask,
    open_service,
    path_of,
    run,
)
from service.commands.console import Commands, Failure, number, remark, say, show, show_json, table, words
from service.commands.maps.backup import export, import_
from service.commands.maps.cameras import cameras
from service.commands.maps.coverage import coverage
from service.commands.maps.places import places, sequences
from service.commands.maps.stretches import stretches
from service.commands.maps.upkeep import align, erase, health, keypoints, merge, prune, rebuild, reencode

maps = typer.Typer(cls=Commands, help="Create, look after and delete maps.", no_args_is_help=True)
maps.add_typer(places, name="places")
maps.add_typer(sequences, name="sequences")
maps.add_typer(cameras, name="cameras")
for name, command in (
    ("health", health),
    ("coverage", coverage),
    ("re-encode", reencode),
    ("align", align),
    ("prune", prune),
    ("rebuild", rebuild),
    ("keypoints", keypoints),
    ("erase", erase),
    ("merge", merge),
    ("stretches", stretches),
    ("export", export),
    ("import", import_),
):
    maps.command(name)(command)

Description = Annotated[str | None, typer.Option(help="Description of the map.")]
Keep = Annotated[
    Literal["none", "thumbnail", "image"] | None, typer.Option(help="Pictures that the map stores of each frame.")
]
Radius = Annotated[float | None, typer.Option(min=0, help="Places within N metres count as the same place.")]
Height = Annotated[float | None, typer.Option(min=0, help="Places over N metres up or down are on another storey.")]
Frames = Annotated[
    int | None,
    typer.Option(min=0, help="Without poses: places within N frames of a sequence count as the same place."),
]
Accuracy = Annotated[
    float | None,
    typer.Option(
        help="Metres: standard deviation of the coordinates of poses, where places do not state it.", min=1e-3, max=1e6
    ),
]
Verification = Annotated[
    bool | None,
    typer.Option(
        "--verification/--no-verification", help="Keep keypoints of each frame, by which answers are verified."
    ),
]
Learning = Annotated[
    Literal["off", "propose", "auto"] | None,
    typer.Option(help="Whether the map learns looks from runs: for review, or by itself where evidence agrees."),
]


@maps.command("list")
def list_maps(url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List all maps, including damaged ones."""

    async def work() -> list[dict[str, Any]]:
        async with open_service(CommandTarget(url, data_dir)) as service:
            return [page async for page in service.pages(path_of("maps"))]

    pages = run(work())
    items = [item for page in pages for item in page["items"]]
    if as_json:
        show_json({"items": items, "quarantined": pages[0]["quarantined"]})
        return
    shown = table("map", "#places", "encoder", "keeps", "description")
    for item in items:
        shown.add_row(item["id"], str(item["places"]), item["encoder"][:26], item["keep"], item["description"])
    show(shown)
    for item in pages[0]["quarantined"]:
        remark(f"{item['id']} is damaged and out of service: {item['reason']}")


@maps.command("show")
def show_map(map_id: MapId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Show one map, and the calibration that was measured for it but not stored, if there is one."""

    async def work() -> tuple[Any, Any]:
        async with open_service(CommandTarget(url, data_dir)) as service:
            found = await service.get(path_of("maps", map_id))
            return found, None if as_json else await service.get(path_of("maps", map_id, "calibration"))

    found, measured = run(work())
    _show_map(found, as_json, None if measured is None else _proposal(measured))


def _proposal(found: dict[str, Any]) -> str | None:
    """A line on the calibration that was measured and not stored, beside the one in force; None if there is none."""
    now, then = found["now"], found["proposed"]
    proposed = None if then is None else found["measured"]["report"]["calibration"]
    if now is None or proposed is None or proposed == found["calibration"]:
        return None
    pairs = ((name, number(now[name]["value"]), number(then[name]["value"])) for name in ("recall", "precision"))
    changes = ", ".join(f"{name} {before} → {after}" for name, before, after in pairs)
    return f"{proposed['source']}: {changes}"


@maps.command("create")
def create_map(
    map_id: MapId,
    encoder: Annotated[str | None, typer.Option(help="Name or identity; default: the service's.")] = None,
    description: Description = None,
    keep: Keep = None,
    same_place_radius: Radius = None,
    same_place_height: Height = None,
    same_place_frames: Frames = None,
    pose_accuracy: Accuracy = None,
    verification: Verification = None,
    learning: Learning = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Create a map. Its encoder cannot be changed later."""
    given = _given(
        description,
        keep,
        same_place_radius,
        same_place_height,
        same_place_frames,
        pose_accuracy,
        verification,
        learning,
    )
    body = {"id": map_id, **given, **({} if encoder is None else {"encoder": encoder})}
    _show_map(ask(CommandTarget(url, data_dir), "POST", path_of("maps"), json=body).json(), as_json)


@maps.command("edit")
def edit_map(
    map_id: MapId,
    description: Description = None,
    keep: Keep = None,
    same_place_radius: Radius = None,
    same_place_height: Height = None,
    same_place_frames: Frames = None,
    pose_accuracy: Accuracy = None,
    verification: Verification = None,
    learning: Learning = None,
    threshold: Annotated[float | None, typer.Option(help="Least decision value of a recognized place.")] = None,
    margin: Annotated[float | None, typer.Option(min=0, help="Least lead over the best rival.")] = None,
    default_calibration: Annotated[
        bool, typer.Option("--default-calibration", help="Go back to the encoder's threshold and margin.")
    ] = False,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Change settings of a map; the others stay as they are."""
    changes = _given(
        description,
        keep,
        same_place_radius,
        same_place_height,
        same_place_frames,
        pose_accuracy,
        verification,
        learning,
    )
    calibration = {"threshold": threshold, "margin": margin}
    calibration = {name: value for name, value in calibration.items() if value is not None}
    if calibration and default_calibration:
        raise typer.BadParameter("--default-calibration cannot be combined with --threshold or --margin")
    if calibration or default_calibration:
        changes["calibration"] = calibration or None
    if not changes:
        raise typer.BadParameter("give at least one setting to change")

    async def work() -> Any:
        async with open_service(CommandTarget(url, data_dir)) as service:
            # The edit is refused if somebody else has changed the map in between.
            seen = await service.request("GET", path_of("maps", map_id))
            headers = {"If-Match": seen.headers["ETag"]}
            return (await service.request("PATCH", path_of("maps", map_id), json=changes, headers=headers)).json()

    _show_map(run(work()), as_json)


@maps.command("delete")
def delete_map(
    map_id: MapId,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Delete a map and all its places."""
    path = path_of("maps", map_id)
    if not yes:
        typer.confirm(f"Delete the map {map_id} and all its places?", abort=True)
    ask(CommandTarget(url, data_dir), "DELETE", path)
    remark(f"The map {map_id} is deleted.")


@maps.command("verify")
def verify_map(map_id: MapId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Read all that is stored of a map and check it; the exit status is 1 if it is damaged."""
    report = ask(CommandTarget(url, data_dir), "POST", path_of("maps", map_id, "verify")).json()
    if as_json:
        show_json(report)
    if not report["ok"]:
        raise Failure(f"The map {map_id} is damaged: {' '.join(report['problems'])}")
    if not as_json:
        say(f"The map {map_id} is not damaged: {report['places']} places were checked.")


def _given(
    description: str | None,
    keep: str | None,
    radius: float | None,
    height: float | None,
    frames: int | None,
    accuracy: float | None,
    verification: bool | None,
    learning: str | None,
) -> dict[str, Any]:
    settings = {
        "description": description,
        "keep": keep,
        "same_place_radius": radius,
        "same_place_height": height,
        "same_place_frames": frames,
        "pose_accuracy": None if accuracy is None else {"metres": accuracy},
        "verification": verification,
        "learning": None if learning is None else {"mode": learning},
    }
    return {name: value for name, value in settings.items() if value is not None}


def _show_map(found: dict[str, Any], as_json: bool, proposal: str | None = None) -> None:
    if as_json:
        show_json(found)
        return
    shown = table("field", "value", title=f"Map {found['id']}")
    for name, value in found.items():
        if name == "calibration" and value is not None:
            shown.add_row(
                name, f"{value['source']}: threshold {number(value['threshold'])}, margin {value['margin']:g}"
            )
            if proposal is not None:
                shown.add_row("proposed calibration", proposal)
        elif name != "id":
            shown.add_row(name, words(value))
    show(shown)
