"""``placerec maps sequences``: the traverses of a map."""

from __future__ import annotations

from typing import Annotated

import typer

from service.commands.connection.client import AsJson, DataDir, Target, Url, ask, list_items, path_of
from service.commands.console import Commands, remark, show, show_json, table

sequences = typer.Typer(cls=Commands, help="List and forget the traverses of a map.", no_args_is_help=True)

MapId = Annotated[str, typer.Argument(metavar="MAP", help="The map's id.", show_default=False)]


@sequences.command("list")
def list_sequences(map_id: MapId, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List a map's traverses."""
    found = list_items(Target(url, data_dir), path_of("maps", map_id, "sequences"))
    if as_json:
        show_json(found)
        return
    shown = table("sequence", "#places", "first", "last")
    for item in found:
        shown.add_row(item["name"] or "–", str(item["places"]), item.get("first_at") or "–", item.get("last_at") or "–")
    show(shown)


@sequences.command("forget")
def forget_sequence(
    map_id: MapId,
    sequence: Annotated[str, typer.Argument(metavar="SEQUENCE", help="Name of the traverse.", show_default=False)],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Forget all places of a traverse for good."""
    if not yes:
        typer.confirm(f"Forget all places of the sequence {sequence} of the map {map_id}?", abort=True)
    forgotten = ask(Target(url, data_dir), "DELETE", path_of("maps", map_id, "sequences", sequence)).json()
    remark(f"The sequence {sequence} is forgotten: {forgotten['places']} places.")
