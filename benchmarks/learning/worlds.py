"""The places that robots walk through: how each looks on the day the map was made, and in any later run.

``corridor`` and ``lip6`` were walked twice: the map is one traverse, every later run the other, in drawn conditions.
``cameras`` are fixed cameras with photographs of days and nights over years; each is walked past, so that a place is a
window of its picture, and no two places of a run that follow one another are cut from one photograph.  ``nordland`` is
a railway in summer and winter; its nights are drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.day.pictures import another_look
from benchmarks.day.walks import METRES, WalkPair
from benchmarks.day.walks import corridor as corridor_walk
from benchmarks.day.walks import lip6 as lip6_walk
from benchmarks.learning.conditions import CONDITIONS
from core.frames.images import decode
from core.frames.preprocessing import Pixels
from lab.training.photographs import MIXED_CAMERAS, find_photographs, read
from lab.training.validation import DAYLIGHT

DaysAndNights: TypeAlias = tuple[list[Pixels], list[Pixels]]
"""The pictures of a fixed camera by day, and those by night."""

CUTS, WINDOW = 8, 0.4
"""Places that are cut from each fixed camera, and the share of its picture's width and height that each shows."""


@dataclass(frozen=True)
class RobotWorld:
    """Places along a way.

    first: their pictures on the day of the map.
    later: returns the picture at a place in a condition and a run; by their numbers.
    metres: float [k], where along the way each later picture was taken; those of a robot that goes on.
    right: bool [k, n], the places of the map that a later picture shows.
    conditions: those that this world has, the one of the map first.
    strangers: pictures of another building or street.
    spacing: metres between two places of the map.
    keypoints: whether its pictures are large enough to find keypoints in.
    """

    name: str
    first: Sequence[Pixels]
    later: Callable[[int, str, int], Pixels]
    metres: NDArray[np.floating]
    right: NDArray[np.bool_]
    conditions: tuple[str, ...]
    strangers: Sequence[Pixels]
    spacing: float = METRES
    keypoints: bool = True


def _strangers(folder: Path, count: int = 160) -> list[Pixels]:
    paths = find_photographs(folder)
    return [read(path) for path in paths[:: max(1, len(paths) // count)][:count]]


def _walked(walk: WalkPair, strangers: Sequence[Pixels]) -> RobotWorld:
    """A walk whose second traverse is seen in drawn conditions."""
    references, frames = ([decode(one) for one in side] for side in (walk.references, walk.frames))

    def later(number: int, condition: str, run: int) -> Pixels:
        return CONDITIONS[condition](frames[number], number, run)

    return RobotWorld(walk.name, references, later, walk.metres, walk.shown, tuple(CONDITIONS), strangers, walk.spacing)


def corridor(datasets: Path) -> RobotWorld:
    """A corridor indoors."""
    return _walked(corridor_walk(datasets), _strangers(datasets / "train/tower"))


def lip6(datasets: Path) -> RobotWorld:
    """Streets of Paris."""
    return _walked(lip6_walk(datasets), _strangers(datasets / "train/camvid"))


def _day_night(datasets: Path) -> list[DaysAndNights]:
    folders = [one for one in sorted((datasets / "train/day_night").iterdir()) if one.is_dir()]
    folders = [one for one in folders if one.name not in MIXED_CAMERAS]
    return [
        (list(map(read, sorted(one.glob("day_*")))), list(map(read, sorted(one.glob("night_*"))))) for one in folders
    ]


def _webcams(datasets: Path) -> list[DaysAndNights]:
    shown = []
    for folder in sorted(one for one in (datasets / "eval/webcams").iterdir() if one.is_dir()):
        pictures = [read(path) for path in find_photographs(folder)]
        shown.append(
            ([one for one in pictures if one.mean() > DAYLIGHT], [one for one in pictures if one.mean() <= DAYLIGHT])
        )
    return shown


def cameras(datasets: Path) -> RobotWorld:
    """Fixed cameras by day and by night."""
    return _of_cameras(_day_night(datasets) + _webcams(datasets), datasets)


def training_cameras(datasets: Path) -> RobotWorld:
    """The fixed cameras of the training data by day and by night."""
    return _of_cameras(_day_night(datasets), datasets)


def _of_cameras(shown: list[DaysAndNights], datasets: Path) -> RobotWorld:
    shown = [(days, nights) for days, nights in shown if len(days) > 4 and len(nights) > 4]
    count = CUTS * len(shown)

    def cut(pixels: Pixels, number: int) -> Pixels:
        height, width = pixels.shape[:2]
        left = round((1 - WINDOW) * width * (number % CUTS) / (CUTS - 1))
        top = round((1 - WINDOW) * height * 0.6)
        return np.ascontiguousarray(pixels[top : top + round(WINDOW * height), left : left + round(WINDOW * width)])

    def later(number: int, condition: str, run: int) -> Pixels:
        random = np.random.default_rng((9, run, number // CUTS, number % 2))
        some = shown[number // CUTS][condition == "night"]
        chosen = some[int(random.integers(1 if condition == "day" else 0, len(some)))]
        return another_look(cut(chosen, number), np.random.default_rng((10, run, number)))

    places = np.arange(count)
    right = (np.abs(places[:, None] - places) <= 2) & (places[:, None] // CUTS == places // CUTS)
    first = [cut(shown[number // CUTS][0][0], number) for number in range(count)]
    strangers = _strangers(datasets / "train/facades")
    return RobotWorld("cameras", first, later, METRES * places, right, ("day", "night"), strangers)


def _sized(pixels: Pixels, interpolation: int = cv2.INTER_CUBIC) -> Pixels:
    """A picture at the size at which nordland's are drawn in other conditions."""
    return np.asarray(cv2.resize(pixels, (128, 64), interpolation=interpolation), np.uint8)


def nordland(datasets: Path, places: int = 150, step: int = 6, start: int = 300) -> RobotWorld:
    """A railway; a place is ``step`` frames from the next, and two to either side are tolerated, fewer than usual."""
    folder = datasets / "eval/nordland_tiny"
    numbers = start + step * np.arange(places)
    summer, winter = (find_photographs(folder / season) for season in ("summer", "winter"))

    def picture(number: int, files: Sequence[Path], run: int) -> Pixels:
        shift = int(np.random.default_rng((11, run, number)).integers(-1, 2))
        return read(files[int(numbers[number]) + shift])

    def later(number: int, condition: str, run: int) -> Pixels:
        season = winter if condition.startswith("winter") else summer
        drawn = CONDITIONS["night" if condition.endswith("night") else "day"]
        return drawn(_sized(picture(number, season, run)), number, run)

    first = [_sized(read(summer[one])) for one in numbers.tolist()]
    at = np.arange(places)
    return RobotWorld(
        "nordland",
        first,
        later,
        METRES * at,
        np.abs(at[:, None] - at) <= 2,
        ("summer", "summer night", "winter", "winter night"),
        [_sized(one, cv2.INTER_AREA) for one in _strangers(datasets / "train/roads")],
        keypoints=False,
    )


WORLDS: dict[str, Callable[[Path], RobotWorld]] = {
    "corridor": corridor,
    "lip6": lip6,
    "cameras": cameras,
    "nordland": nordland,
}
