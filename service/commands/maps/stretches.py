"""``placerec maps stretches``: what runs have found beyond a map, which an operator accepts or rejects."""

from __future__ import annotations

from typing import Annotated

import typer

from service.commands.connection.client import AsJson, CommandTarget, DataDir, MapId, Url, ask, path_of
from service.commands.console import number, say, show, show_json, table
from service.commands.jobs import Wait, show_outcome, submit


def stretches(
    map_id: MapId,
    accept: Annotated[str | None, typer.Option(help="Make the frames of this stretch places of the map.")] = None,
    reject: Annotated[
        str | None, typer.Option(help="Throw the frames of this stretch away; its ground is not proposed again.")
    ] = None,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """List the stretches of new ground that wait for review; or accept or reject one."""
    target, path = CommandTarget(url, data_dir), path_of("maps", map_id, "review", "stretches")
    if accept is not None and reject is not None:
        raise typer.BadParameter("--accept cannot be combined with --reject")
    if accept is not None:
        show_outcome(submit(target, path_of("maps", map_id, "review", "stretches", accept), {}, wait), as_json)
        return
    if reject is not None:
        ask(target, "DELETE", path_of("maps", map_id, "review", "stretches", reject))
        say(f"The stretch {reject} is thrown away.")
        return
    found = ask(target, "GET", path).json()["items"]
    if as_json:
        show_json(found)
        return
    shown = table("stretch", "#frames", "#m", "leaves", "returns", "why")
    for one in found:
        count, length = str(len(one["frames"])), number(one["length"], 0)
        shown.add_row(one["id"], count, length, one["leaves"], one["returns"], one["why"])
    show(shown)
