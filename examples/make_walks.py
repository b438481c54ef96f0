"""Cut two walks past the same places out of the pictures that ``make_pictures.py`` draws.

    python examples/make_walks.py pictures

It writes the folders ``monday`` and ``tuesday`` with a ``places.csv`` each: eight frames to a picture, two metres
apart.  On Tuesday the light is different, and the walk ends in a street that Monday's never saw.
``tuesday/labels.csv`` says which of Monday's places each frame of Tuesday shows.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import cv2

WALKS = {
    "monday": ("places/corridor", "places/kitchen", "places/yard"),
    "tuesday": ("camera/1-corridor", "camera/2-kitchen", "camera/3-yard", "camera/4-street"),
}
STEPS = 8  # frames cut out of one picture
SHIFT = 20  # pixels from one frame to the next
WIDTH = 260  # pixels of a frame


def make_walks(pictures: Path, folder: Path) -> None:
    """Write both walks below ``folder``."""
    for walk, names in WALKS.items():
        (folder / walk).mkdir(parents=True, exist_ok=True)
        rows = []
        for number, name in enumerate(names):
            picture = cv2.imread(str(pictures / f"{name}.jpg"))
            if picture is None:
                raise SystemExit(f"There is no picture {pictures / name}.jpg; draw it with make_pictures.py.")
            for step in range(STEPS):
                file = f"{number}{step}.jpg"
                cv2.imwrite(str(folder / walk / file), picture[:, SHIFT * step : SHIFT * step + WIDTH])
                rows.append((file, f"{walk}-{number}{step}", 100 * number + 2 * step, 0))
        write_table(folder / walk / "places.csv", ("file", "id", "x", "y"), rows)
    known = len(WALKS["monday"])
    labels = [
        (f"{number}{step}.jpg", f"monday-{number}{step}" if number < known else "")
        for number in range(len(WALKS["tuesday"]))
        for step in range(STEPS)
    ]
    write_table(folder / "tuesday" / "labels.csv", ("file", "place"), labels)


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description="Cut two walks out of the pictures of make_pictures.py.")
    parser.add_argument("pictures", type=Path, nargs="?", default=Path("pictures"))
    parser.add_argument("folder", type=Path, nargs="?", default=Path())
    arguments = parser.parse_args()
    make_walks(arguments.pictures, arguments.folder)
    for walk in WALKS:
        print(arguments.folder / walk)


if __name__ == "__main__":
    main()
