"""The upkeep of maps: ``placerec maps health``, ``re-encode``, ``rebuild``, ``keypoints``, ``align``, ``prune``,
``erase`` and ``merge``.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import typer

from core.places import place_and_look
from service.commands.connection.client import (
    AsJson,
    CommandTarget,
    DataDir,
    MapId,
    Refused,
    Service,
    Url,
    ask,
    open_service,
    path_of,
    run,
)
from service.commands.console import Failure, number, remark, say, show, show_json, table
from service.commands.jobs import Wait, followed, show_outcome, submit
from service.commands.maps.places import show_erased

Yes = Annotated[bool, typer.Option("--yes", help="Do it; otherwise the command only reports what it would do.")]


def health(
    map_id: MapId,
    limit: Annotated[
        int, typer.Option(min=1, max=1000, help="Most places, gaps and stretches to list of each kind.")
    ] = 20,
    seconds: Annotated[
        float, typer.Option(min=0.1, max=20, help="Most seconds to spend on the frames of the map.")
    ] = 5.0,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Report how well a map works: places that never match or match too often, gaps, drift, stretches to redo."""
    params = {"limit": limit, "seconds": seconds}
    report = ask(CommandTarget(url, data_dir), "GET", path_of("maps", map_id, "health"), params=params).json()
    if as_json:
        show_json(report)
        return
    answers, aliasing = report["answers"], report["aliasing"]
    facts = table("of", "what", title=f"Map {map_id}")
    facts.add_row("places", str(report["places"]))
    facts.add_row("queries", f"{answers['queries']}, of which {answers['recognized']} recognized")
    silent = report["never_matched"]
    if silent is not None:
        chance = f"{silent['count']} ({silent['by_chance']:.1f} by chance): {', '.join(silent['places'])}"
        facts.add_row("never matched", chance)
    facts.add_row("hubs", ", ".join(f"{hub['place']} ({hub['count']}×)" for hub in aliasing["hubs"]) or "none")
    pairs = ", ".join(f"{alias['place']}→{alias['other']}" for alias in aliasing["aliases"])
    facts.add_row("taken for others", pairs or "none")
    for name in ("score_trend", "unknown_trend"):
        if (trend := answers[name]) is not None:
            drifting = "drifts" if trend["significant"] else "does not drift"
            facts.add_row(name.partition("_")[0], f"{drifting}: {trend['per_week']:+.4f} ± {trend['error']:.4f} a week")
    show(facts)
    again = table("sequence", "from", "to", "why", "#weight", title="Record again")
    for stretch in report["retraverse"]:
        why = ", ".join(stretch["reasons"])
        again.add_row(stretch["sequence"], stretch["first"], stretch["last"], why, number(stretch["weight"], 1))
    if report["retraverse"]:
        show(again)
    else:
        say("No stretch has to be recorded again.")
    for stop in report["stops"]:
        remark(
            f"{stop['frames']} frames of traverse {stop['sequence']} show one view, from place {stop['place']} "
            f"on: placerec maps prune {map_id} --yes deletes all but the first."
        )
    if report["calibration_doubt"]:
        remark(f"The map's own calibration is not to be trusted. {report['calibration_doubt']}")
    if not report["complete"]:
        remark("The time was up before the whole map was examined; --seconds gives it more.")


def reencode(
    map_id: MapId,
    to: Annotated[str, typer.Argument(metavar="NEW", help="Id of the new map.", show_default=False)],
    encoder: Annotated[str | None, typer.Option(help="Name or identity; default: the service's.")] = None,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Create a new map from the images of a map, with another encoder."""
    body = {"to": to, **({} if encoder is None else {"encoder": encoder})}
    show_outcome(submit(CommandTarget(url, data_dir), path_of("maps", map_id, "re-encode"), body, wait), as_json)


def rebuild(
    map_id: Annotated[str | None, typer.Argument(metavar="[MAP]", help="The map's id.", show_default=False)] = None,
    all_: Annotated[bool, typer.Option("--all", help="Instead: the indexes of all maps, one after another.")] = False,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Rebuild the search index of a large map from its descriptors, while it is searched."""
    target = CommandTarget(url, data_dir)
    if (map_id is None) is not all_:
        raise typer.BadParameter("Name a map, or give --all.")
    if map_id is not None:
        show_outcome(submit(target, path_of("maps", map_id, "rebuild"), {}, wait), as_json)
        return
    if not wait:
        raise typer.BadParameter("--all waits for each map before it begins the next.")
    _show_rebuilt(_rebuild_all(target), as_json)


def _rebuild_all(target: CommandTarget) -> dict[str, dict[str, Any]]:
    """Rebuild the indexes of all maps; returns, by map, the job, or ``detail`` alone of a map that is refused."""

    async def work() -> dict[str, dict[str, Any]]:
        async with open_service(target) as service:
            pages = [page async for page in service.pages(path_of("maps"))]
            maps = {one["id"] for page in pages for one in (*page["items"], *page["quarantined"])}
            return {map_id: await _rebuilt(service, map_id) for map_id in sorted(maps)}

    return run(work())


async def _rebuilt(service: Service, map_id: str) -> dict[str, Any]:
    try:
        submitted = await service.request("POST", path_of("maps", map_id, "rebuild"), json={})
        return await followed(service, submitted.json())
    except Refused as error:
        return {"state": "refused", "problem": {"detail": str(error)}}


def _show_rebuilt(found: dict[str, dict[str, Any]], as_json: bool) -> None:
    """Show the outcome of each map.

    Raises:
        Failure: the index of a map was not rebuilt.
    """
    if as_json:
        show_json(found)
    else:
        shown = table("map", "state", "why")
        for map_id, job in found.items():
            shown.add_row(map_id, job["state"], (job["problem"] or {}).get("detail", ""))
        show(shown)
    if failed := [map_id for map_id, job in found.items() if job["state"] != "succeeded"]:
        raise Failure(f"Not rebuilt: {', '.join(failed)}.")


def erase(
    map_id: MapId,
    place: Annotated[list[str] | None, typer.Option(help="A place with its looks; can be repeated.")] = None,
    look: Annotated[
        list[str] | None, typer.Option(metavar="PLACE/LOOK", help="One look of a place; can be repeated.")
    ] = None,
    sequence: Annotated[str | None, typer.Option(help="The places of this traverse.")] = None,
    camera: Annotated[str | None, typer.Option(help="Only what this camera took.")] = None,
    after: Annotated[str | None, typer.Option(help="Only frames of this time or later, ISO 8601.")] = None,
    before: Annotated[str | None, typer.Option(help="Only frames of this time or earlier, ISO 8601.")] = None,
    session: Annotated[
        str | None, typer.Option(help="What this session has sent, and the looks that its run has taught.")
    ] = None,
    bags: Annotated[
        bool, typer.Option("--bags", help="Also remove all bags of the map that wait to be enrolled.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Erase frames for good: of places, a traverse, a time or a session; by default, what was deleted has left."""
    given = {"sequence": sequence, "camera": camera, "after": after, "before": before}
    conditions = {name: value for name, value in given.items() if value is not None}
    ids = [*(place or []), *(look or [])]
    if ids and conditions:
        raise typer.BadParameter("--place and --look cannot be combined with conditions")
    for place_id in place or []:
        path_of(place_id)  # refuses an invalid name before the request
    for address in look or []:
        if not all(place_and_look(address)):
            raise typer.BadParameter(f"{address} is no look: write PLACE/LOOK")
        path_of(*address.split("/"))
    body: dict[str, Any] = {"ids": ids} if ids else {"filter": conditions} if conditions else {}
    body |= {} if session is None else {"session": session}
    body |= {"bags": True} if bags else {}
    path = path_of("maps", map_id, "erase")
    if body and not yes:
        typer.confirm(f"Erase from the map {map_id} for good: {described(body)}?", abort=True)
    job = submit(CommandTarget(url, data_dir), path, body, wait)
    if as_json or not wait:
        show_outcome(job, as_json)
    else:
        show_erased(job, bool(body))


def described(order: dict[str, Any]) -> str:
    """An order to erase frames in words."""
    parts = [", ".join(order["ids"])] if "ids" in order else []
    parts += [f"{name} {value}" for name, value in order.get("filter", {}).items()]
    parts += [f"session {order['session']}"] if "session" in order else []
    parts += ["all bags that wait"] if order.get("bags") else []
    return "; ".join(parts)


def keypoints(
    map_id: MapId, wait: Wait = True, url: Url = None, data_dir: DataDir = None, as_json: AsJson = False
) -> None:
    """Find the keypoints of places that have none, in the pictures that the map keeps."""
    show_outcome(submit(CommandTarget(url, data_dir), path_of("maps", map_id, "keypoints"), {}, wait), as_json)


def align(
    map_id: MapId,
    sequence: Annotated[str, typer.Option(help="The traverse to align.", show_default=False)],
    with_: Annotated[
        list[str] | None,
        typer.Option("--with", help="A traverse to align it with; can be repeated. Default: all others."),
    ] = None,
    poses: Annotated[
        bool, typer.Option("--poses/--no-poses", help="Give frames without a pose that of their counterpart.")
    ] = True,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only report what would be stored.")] = False,
    undo: Annotated[
        bool, typer.Option("--undo", help="Instead: forget the counterparts of the traverse, and poses it was given.")
    ] = False,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Find which frames of a traverse show the places of others; these are then the same places, not rivals."""
    if undo and with_:
        raise typer.BadParameter("--undo cannot be combined with --with")
    body = {"sequence": sequence, "with": [] if undo else with_ or None, "poses": poses, "dry_run": dry_run}
    show_outcome(submit(CommandTarget(url, data_dir), path_of("maps", map_id, "align"), body, wait), as_json)


def prune(
    map_id: MapId,
    max_recall_loss: Annotated[
        float, typer.Option(min=0, max=1, help="Greatest share of queries that may be lost.")
    ] = 0.01,
    similarity: Annotated[
        float | None, typer.Option(help="Instead: least similarity of two frames for one to replace the other.")
    ] = None,
    sequence: Annotated[str | None, typer.Option(help="Delete only places of this traverse.")] = None,
    queries: Annotated[str | None, typer.Option(help="Measure the loss with the frames of this traverse.")] = None,
    yes: Yes = False,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Delete places that their neighbours can replace; without --yes only report the loss of recall."""
    given = {"similarity": similarity, "sequence": sequence, "queries": queries}
    body: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    body |= {"max_recall_loss": max_recall_loss, "dry_run": not yes}
    show_outcome(submit(CommandTarget(url, data_dir), path_of("maps", map_id, "prune"), body, wait), as_json)
    if not yes:
        remark("Nothing is deleted without --yes: this is what would be.")


def merge(
    map_id: MapId,
    other: Annotated[str, typer.Argument(metavar="OTHER", help="The map whose places are added.", show_default=False)],
    on_conflict: Annotated[
        Literal["refuse", "rename", "skip"],
        typer.Option(help="The treatment of a name that means different things in the two maps."),
    ] = "refuse",
    prefix: Annotated[
        str | None, typer.Option(help="Prefix of renamed places, sequences and cameras; default: the id of OTHER.")
    ] = None,
    yes: Yes = False,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Add the places of another map to this one; without --yes only report what would be added."""
    body: dict[str, Any] = {"from": other, "on_conflict": on_conflict, "dry_run": not yes}
    body |= {} if prefix is None else {"prefix": prefix}
    show_outcome(submit(CommandTarget(url, data_dir), path_of("maps", map_id, "merge"), body, wait), as_json)
