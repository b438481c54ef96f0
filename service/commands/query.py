"""``placerec query``: recognize the places where frames were taken."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from service.commands.connection.client import (
    DataDir,
    Refused,
    Service,
    Target,
    Url,
    media_type,
    open_service,
    path_of,
    read_bytes,
    run,
)
from service.commands.console import Failure, complain, number, show, table

PATIENCE = 30.0
"""Seconds for which a frame is repeated while the service is overloaded."""


def query(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE…", help="Frames to localize.", show_default=False)],
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
    url: Url = None,
    data_dir: DataDir = None,
    as_json: Annotated[bool, typer.Option("--json", help="Write one JSON object a line for each frame.")] = False,
) -> None:
    """Recognize the place of a map that each image shows, if any.

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
    failures = run(_query(Target(url, data_dir), map_id, images, parameters, as_json))
    if failures:
        raise typer.Exit(1)


def _position(near: str | None, geographic: bool) -> dict[str, Any]:
    if near is None:
        return {}
    parts = near.split(",")
    if len(parts) != 2:
        raise Failure(f"--near {near} is not two numbers with a comma between them.")
    return dict(zip(("latitude", "longitude") if geographic else ("x", "y"), parts, strict=True))


async def _query(target: Target, map_id: str, images: list[Path], parameters: dict[str, Any], as_json: bool) -> int:
    failures = 0
    rows = table(
        "image", "verdict", "place", "#probability", "#score", "#margin", "best match", "#ms", title=f"Map {map_id}"
    )
    async with open_service(target) as service:
        for image in images:
            data = read_bytes(image)
            try:
                answer = await _ask(service, map_id, data, parameters)
            except Refused as refused:
                if refused.status not in (400, 413, 415, 422):
                    raise
                failures += 1
                complain(f"{image}: {refused}")
                continue
            if as_json:
                typer.echo(json.dumps({"file": str(image), **answer}, ensure_ascii=False))
            else:
                rows.add_row(str(image), *_cells(answer))
    if rows.row_count:
        show(rows)
    return failures


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
    return [
        answer["verdict"],
        answer["place"]["id"] if answer["place"] else "–",
        number(answer["probability"]),
        number(answer["score"]),
        number(answer["margin"]),
        matches[0]["place"]["id"] if matches else "–",
        number(answer["milliseconds"]["total"], 1),
    ]
