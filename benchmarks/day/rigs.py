"""Rigs of two cameras: ``python -m benchmarks.day.rigs``.

Each frame of a walk is sent as two parts of one moment to a real service: doubled; beside a blocked camera; beside a
frame half of the walk away, which contradicts it; and as its left and its right part, which are two honest cameras.
Beside each rig stands what its best camera says alone.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, TypeAlias

import cv2
import numpy as np
import typer

from benchmarks.day import pictures
from benchmarks.day.maps import make_map, shown_by
from benchmarks.day.robots import Verify
from benchmarks.day.walks import WALKS, WalkPair, pixels
from benchmarks.process import service
from benchmarks.report import report
from core.frames.preprocessing import Pixels
from placerec_client import Client

Rig: TypeAlias = Mapping[str, bytes]
"""The files of one moment by the names of their cameras."""

WIDTH = 0.6
"""The share of the frame's width that each of two honest cameras sees."""


def _noise(shown: Pixels, number: int) -> Pixels:
    return np.random.default_rng(number).integers(0, 256, shown.shape, dtype=np.uint8)


def _hand(shown: Pixels, number: int) -> Pixels:
    return pictures.hand(shown, np.random.default_rng(number), number)


BLOCKED: dict[str, Callable[[Pixels, int], Pixels]] = {
    "black": lambda shown, _: np.zeros_like(shown),
    "grey": lambda shown, _: np.full_like(shown, 128),
    "noise": _noise,
    "hand": _hand,
}
KINDS = ("doubled", *(f"blocked: {name}" for name in BLOCKED), "contradicting", "honest")


def rig_of(kind: str, walk: WalkPair, number: int) -> Rig:
    """The frames of the cameras of a rig at a frame of the walk.

    Args:
        kind: one of ``KINDS``.
    """
    data = walk.frames[number]
    if kind == "doubled":
        return {"left": data, "right": data}
    if kind == "contradicting":
        return {"left": data, "right": walk.frames[(number + len(walk.frames) // 2) % len(walk.frames)]}
    shown = pixels(data)
    if kind == "honest":
        wide = round(WIDTH * shown.shape[1])
        return {"left": _file(shown[:, :wide]), "right": _file(shown[:, -wide:])}
    return {"left": data, "right": _file(BLOCKED[kind.removeprefix("blocked: ")](shown, number))}


def _file(shown: Pixels) -> bytes:
    return bytes(cv2.imencode(".png", shown)[1].tobytes())


class RigAnswer:
    """An answer of one map: its verdict, what it shows best, and its probability.

    shown: the reference of the best match; None without a match.
    named: the references of the best match and of its rivals.
    """

    def __init__(self, client: Client, map_id: str, frames: Rig | bytes, verify: Verify) -> None:
        """Ask."""
        answer = client.query(frames, maps=[map_id], verify=verify)
        self.verdict, self.probability = answer.verdict, answer.probability
        self.shown = shown_by(answer.matches[0].place.id) if answer.matches else None
        rivals = [place for group in answer.maps[0].rivals or () for place in group.places]
        self.named = {self.shown, *(shown_by(place) for place in rivals)}

    def outcome(self, right: frozenset[int]) -> str:
        """``right`` or ``wrong`` if it is recognized, else its verdict."""
        return self.verdict if self.verdict != "recognized" else "right" if self.shown in right else "wrong"


def answers(
    client: Client, map_id: str, walk: WalkPair, kind: str, verify: Verify, numbers: Sequence[int]
) -> Iterator[tuple[frozenset[int], RigAnswer, list[RigAnswer]]]:
    """The references that are right, the answer to the rig, and those to each of its cameras alone."""
    for number in numbers:
        rig = rig_of(kind, walk, number)
        alone = {data: RigAnswer(client, map_id, data, verify) for data in dict.fromkeys(rig.values())
                 if not kind.startswith("blocked") or data == rig["left"]}  # fmt: skip
        yield walk.right(number), RigAnswer(client, map_id, rig, verify), list(alone.values())


def apart(one: RigAnswer, other: RigAnswer) -> bool:
    """Whether two answers recognize places that are not the same."""
    both = one.verdict == other.verdict == "recognized" and one.shown is not None and other.shown is not None
    return both and abs((one.shown or 0) - (other.shown or 0)) > 2


def main(
    verify: Annotated[str, typer.Option(help="never, auto or always.")] = "auto",
    walk: Annotated[str, typer.Option(help=f"One of {', '.join(WALKS)}.")] = "corridor",
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    every: Annotated[int, typer.Option(min=1, help="Take each so-manieth frame.")] = 3,
) -> None:
    """Ask, and print the table."""
    when: Verify = "never" if verify == "never" else "always" if verify == "always" else "auto"
    driven = WALKS[walk](datasets)
    numbers = range(0, len(driven.frames), every)
    rows: list[tuple[object, ...]] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder) / "data", log=Path(folder) / "log") as process,
        Client(str(process.client.base_url)) as client,
    ):
        make_map(client, "rigs", driven, "plain", "small", ())
        for kind in KINDS:
            found = list(answers(client, "rigs", driven, kind, when, numbers))
            if kind == "contradicting":
                found = [one for one in found if apart(*one[2])]
            counts = Counter(answer.outcome(right) for right, answer, _ in found)
            singly = [[one.outcome(right) == "right" for one in alone] for right, _, alone in found]
            doubt = [answer.probability or 0.0 for _, answer, _ in found if answer.verdict == "ambiguous"]
            shown = [counts[one] for one in ("right", "wrong", "ambiguous", "unknown")]
            rows.append((kind, len(found), *shown, int(np.sum(singly, axis=0).max()), f"{max(doubt, default=0):.2f}"))
            print(rows[-1], flush=True)
    columns = ["", "moments", "right", "wrong", "ambiguous", "unknown", "best camera alone", "highest p in doubt"]
    figures = {str(row[0]): list(row[1:]) for row in rows}
    report(f"day-rigs-{walk}-{verify}", f"Rigs of two cameras on {walk}, {verify}", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
