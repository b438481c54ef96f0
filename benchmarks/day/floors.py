"""Two storeys that look alike: ``python -m benchmarks.day.floors``.

The map has a walk twice, one above the other, the upper one by pictures of the same views with noise.  So nothing but
what is stated tells the storeys apart: a robot is to be recognized on neither, or on its own.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.day.__main__ import Station
from benchmarks.day.maps import fields, fill, shown_by
from benchmarks.day.pictures import another_look, file
from benchmarks.day.walks import WALKS, WalkPair, pixels
from benchmarks.report import report
from placerec_client import Client, NewPlace, Odometry, Session, models

STOREY = 4.0
"""Metres from one storey to the next."""

OUTCOMES = ("right", "wrong storey", "wrong", "ambiguous", "unknown", "z between")


@dataclass(frozen=True)
class FloorRow:
    """A way of asking in such a building.

    levels: whether the places of the map have levels; all have a height.
    states: what the robot states of its storey, if anything.
    session: whether it asks within a session, with odometry, and takes a lift halfway.
    """

    name: str
    levels: bool = True
    states: frozenset[str] = frozenset()
    session: bool = False


ROWS = (
    FloorRow("z alone", levels=False),
    FloorRow("level"),
    FloorRow("stated level", states=frozenset({"level"})),
    FloorRow("session", session=True),
    FloorRow("session through a lift, level stated", states=frozenset({"level"}), session=True),
    FloorRow("session through a lift, height stated", levels=False, states=frozenset({"height"}), session=True),
)


def places(walk: WalkPair, levels: bool) -> Iterator[NewPlace]:
    """The places of both storeys; their ids end with the number of the reference that they show."""
    random = np.random.default_rng(5)
    for level in (1, 2):
        for number, data in enumerate(walk.references):
            shown = data if level == 1 else file(another_look(pixels(data), random))
            at = fields(walk.pose(number * walk.spacing), f"storey-{level}") | {"z": STOREY * (level - 1)}
            yield NewPlace(f"{level}-{number:05d}", shown, at | ({"level": level} if levels else {}))


def make_building(client: Client, map_id: str, walk: WalkPair, levels: bool) -> None:
    """Enrol such a map.

    Raises:
        PlacerecError: a frame was refused.
    """
    fill(client.maps.create(map_id), places(walk, levels))


def _ask(
    client: Client, map_id: str, session: Session | None, picture: bytes, stated: dict[str, object], at: Odometry
) -> tuple[models.QueryAnswer | models.SessionAnswer, models.QueryAnswer]:
    """The answer to a frame, and that to the frame alone."""
    if session is None:
        alone = client.maps[map_id].query(picture, **stated)  # type: ignore[arg-type]
        return alone, alone
    answer = session.send(picture, odometry=at, **stated)  # type: ignore[arg-type]
    return answer, answer.single


def drive(client: Client, map_id: str, walk: WalkPair, row: FloorRow, every: int = 1) -> Counter[str]:
    """How often each outcome came of every so-manieth frame of a walk on the lower storey and, in a session, on."""
    found: Counter[str] = Counter()
    random = np.random.default_rng(6)
    numbers = [number for number in range(0, len(walk.frames), every) if walk.right(number)]
    session = client.maps[map_id].sessions.begin() if row.session else None
    for count, number in enumerate(numbers):
        level = 2 if row.session and count >= len(numbers) // 2 else 1
        picture = walk.frames[number] if level == 1 else file(another_look(pixels(walk.frames[number]), random))
        height = 120.0 + STOREY * (level - 1) + 0.2 * random.normal()
        known: dict[str, object] = {"level": level, "height": height}
        stated = {name: value for name, value in known.items() if name in row.states}
        pose = walk.pose(walk.where(number))
        at = Odometry(pose.x, pose.y, float(np.degrees(pose.heading)))
        answer, alone = _ask(client, map_id, session, picture, stated, at)
        z = None if alone.pose is None else alone.pose.z
        found["z between"] += z is not None and abs(z - STOREY / 2) < STOREY / 2 - 0.5
        if answer.place is None:
            found[answer.verdict] += 1
        elif not answer.place.id.startswith(f"{level}-"):
            found["wrong storey"] += 1
        else:
            found["right" if shown_by(answer.place.id) in walk.right(number) else "wrong"] += 1
    if session is not None:
        session.delete()
    return found


def main(
    walk: Annotated[str, typer.Option(help=f"One of {', '.join(WALKS)}.")] = "corridor",
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    every: Annotated[int, typer.Option(min=1, help="Take each so-manieth frame.")] = 1,
) -> None:
    """Drive through the building, and print the table."""
    driven = WALKS[walk](datasets)
    with tempfile.TemporaryDirectory() as folder:
        station = Station(Path(folder))
        station.start()
        try:
            with Client(station.url) as client:
                for levels in (False, True):
                    make_building(client, f"levels-{levels}".lower(), driven, levels)
                rows = [(row.name, drive(client, f"levels-{row.levels}".lower(), driven, row, every)) for row in ROWS]
        finally:
            station.stop()
    table = [(name, *(found[outcome] for outcome in OUTCOMES)) for name, found in rows]
    title = f"Two storeys that look alike, {STOREY:g} m apart, on {walk}: frames"
    report(f"floors-{walk}", title, ("asking", *OUTCOMES), table, {name: dict(found) for name, found in rows})


if __name__ == "__main__":
    typer.run(main)
