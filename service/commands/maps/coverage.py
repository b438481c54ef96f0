"""``placerec maps coverage``: whether a pose is in a map."""

from __future__ import annotations

from typing import Annotated

import typer

from service.commands.connection.client import AsJson, CommandTarget, DataDir, MapId, Url, ask, path_of
from service.commands.console import number, say, show, show_json, table

SENTENCES = {
    "covered": "The pose is in the map: {places} places within {radius:g} m, the nearest at {distance:.2f} m.",
    "other-direction": "All {places} places within {radius:g} m look elsewhere, at least {turn:.0f}° away.",
    "gap": "The pose is in a gap of {gap[metres]:.1f} m between the places {gap[before]} and {gap[after]}.",
    "outside": "The map has nothing there; its nearest place is {distance:.1f} m away.",
}


def coverage(
    map_id: MapId,
    x: Annotated[float | None, typer.Option(help="Metres in the map's frame; with --y.")] = None,
    y: Annotated[float | None, typer.Option(help="Metres in the map's frame; with --x.")] = None,
    z: Annotated[float | None, typer.Option(help="Metres; without it distances are those in the plane.")] = None,
    latitude: Annotated[float | None, typer.Option(help="Degrees, WGS 84; with --longitude.")] = None,
    longitude: Annotated[float | None, typer.Option(help="Degrees, WGS 84; with --latitude.")] = None,
    heading: Annotated[float | None, typer.Option(help="Degrees: where the camera looks; any if left out.")] = None,
    k: Annotated[int, typer.Option("-k", min=0, max=100, help="Nearest places to list.")] = 5,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Say whether a pose is in a map, and how well: the places, traverses and looks around it."""
    pose = {"x": x, "y": y, "z": z, "latitude": latitude, "longitude": longitude, "heading": heading}
    params = {name: value for name, value in pose.items() if value is not None} | {"k": k}
    found = ask(CommandTarget(url, data_dir), "GET", path_of("maps", map_id, "coverage"), params=params).json()
    if as_json:
        show_json(found)
        return
    nowhere = found["distance"] is None
    say("No place of the map has a pose." if nowhere else SENTENCES[found["state"]].format(**found))
    if found["places"]:
        traverses = ", ".join(found["sequences"]) or "none"
        say(f"They have {found['looks']} looks; their traverses: {traverses}.")
    if found["nearest"]:
        shown = table("place", "#metres", "#degrees", "traverse", title="Nearest places")
        for one in found["nearest"]:
            turn = "–" if one["turn"] is None else number(one["turn"], 0)
            shown.add_row(one["place"], number(one["distance"], 2), turn, one["sequence"] or "–")
        show(shown)
