"""``placerec query``: where were these frames taken?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from service.commands.client import (
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
from service.commands.console import complain, number, show, table

PATIENCE = 30.0
"""Seconds for which a frame is sent again while the service is overloaded."""


def query(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE…", help="Frames to localize.", show_default=False)],
    map_id: Annotated[str, typer.Option("--map", "-m", help="The map to search.", show_default=False)],
    k: Annotated[int, typer.Option("-k", min=1, max=100, help="How many matches to ask for.")] = 5,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: Annotated[bool, typer.Option("--json", help="Write one JSON object a frame and line.")] = False,
) -> None:
    """Say for each image which place of a map it shows, if any.

    An unknown place is an answer, not an error; the exit status is 1 only if an image got none.
    """
    failures = run(_query(Target(url, data_dir), map_id, images, k, as_json))
    if failures:
        raise typer.Exit(1)


async def _query(target: Target, map_id: str, images: list[Path], k: int, as_json: bool) -> int:
    failures = 0
    rows = table("image", "verdict", "place", "#score", "#margin", "best match", "#ms", title=f"Map {map_id}")
    async with open_service(target) as service:
        for image in images:
            data = read_bytes(image)
            try:
                answer = await _ask(service, map_id, data, k)
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


async def _ask(service: Service, map_id: str, data: bytes, k: int) -> dict[str, Any]:
    response = await service.request(
        "POST",
        path_of("maps", map_id, "query"),
        params={"k": k},
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
        number(answer["score"]),
        number(answer["margin"]),
        matches[0]["place"]["id"] if matches else "–",
        number(answer["milliseconds"]["total"], 1),
    ]
