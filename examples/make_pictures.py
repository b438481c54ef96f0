"""Draw the pictures of the README's tour: three places, and a second look at each.

    python examples/make_pictures.py pictures

writes ``pictures/places`` (corridor.jpg, kitchen.jpg, yard.jpg: to be enrolled),
``pictures/camera`` (the same places seen again: a step aside, in other light, with noise; and a
street that nobody enrolled).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]  # H x W x 3, BGR
Colour = tuple[int, int, int]

WIDTH, HEIGHT = 400, 300
RIM = 20  # pixels that a step aside may uncover


def canvas(colour: Colour) -> Picture:
    return np.full((HEIGHT, WIDTH, 3), colour, np.uint8)


def box(picture: Picture, x: int, y: int, width: int, height: int, colour: Colour, edge: Colour | None = None) -> None:
    cv2.rectangle(picture, (x, y), (x + width, y + height), colour, -1)
    if edge is not None:
        cv2.rectangle(picture, (x, y), (x + width, y + height), edge, 2)


def polygon(picture: Picture, points: list[tuple[int, int]], colour: Colour) -> None:
    cv2.fillPoly(picture, [np.array(points, np.int32)], colour)


def corridor() -> Picture:
    """A vanishing point, doors on both sides, lamps, a fire extinguisher."""
    picture = canvas((92, 108, 120))
    for step in range(9):  # the floor's tiles
        y = 165 + int(135 * (step / 8) ** 2)
        cv2.line(picture, (0, y), (400, y), (60, 72, 84), 1)
    for x in range(-400, 801, 80):
        cv2.line(picture, (200, 140), (x, 300), (60, 72, 84), 1)
    polygon(picture, [(0, 0), (400, 0), (235, 115), (165, 115)], (226, 230, 230))
    polygon(picture, [(0, 0), (165, 115), (165, 165), (0, 300)], (176, 190, 196))
    polygon(picture, [(400, 0), (235, 115), (235, 165), (400, 300)], (164, 180, 188))
    box(picture, 165, 115, 70, 50, (120, 140, 90), (60, 70, 50))
    for near, far in ((20, 60), (90, 115), (135, 148)):  # doors, left and right
        for mirror in (False, True):
            top, bottom = 140 - (200 - np.array([near, far])) * 0.42, 140 + (200 - np.array([near, far])) * 0.75
            points = [(near, int(top[0])), (far, int(top[1])), (far, int(bottom[1])), (near, int(bottom[0]))]
            placed = [(399 - x if mirror else x, y) for x, y in points]
            polygon(picture, placed, (52, 84, 132) if mirror else (120, 72, 44))
    for y, width in ((12, 90), (58, 50), (88, 28)):
        box(picture, 200 - width // 2, y, width, max(3, width // 8), (255, 255, 255), (150, 160, 160))
    box(picture, 292, 170, 14, 44, (30, 30, 200), (10, 10, 90))
    cv2.circle(picture, (299, 165), 6, (40, 40, 40), -1)
    box(picture, 318, 60, 40, 52, (230, 240, 250), (40, 40, 40))
    for y in range(68, 106, 7):
        cv2.line(picture, (324, y), (350, y), (90, 90, 90), 2)
    return picture


def kitchen() -> Picture:
    """Tiles, cupboards with handles, a stove, a window, a pan."""
    picture = canvas((214, 226, 222))
    for y in range(90, 190, 18):
        for x in range(0, 400, 18):
            box(picture, x, y, 16, 16, (170, 208, 190) if (x // 18 + y // 18) % 3 else (140, 120, 200))
    for x in range(4, 400, 99):
        box(picture, x, 4, 92, 82, (70, 120, 180), (30, 60, 100))
        cv2.circle(picture, (x + 80, 66), 4, (220, 220, 220), -1)
    box(picture, 210, 14, 80, 120, (250, 236, 214), (90, 90, 90))
    cv2.line(picture, (250, 14), (250, 134), (90, 90, 90), 3)
    cv2.line(picture, (210, 74), (290, 74), (90, 90, 90), 3)
    box(picture, 0, 190, 400, 14, (60, 60, 64))
    for x in range(0, 400, 100):
        box(picture, x + 4, 208, 92, 92, (88, 140, 200), (30, 60, 100))
        box(picture, x + 30, 220, 40, 6, (210, 210, 210))
    box(picture, 104, 208, 92, 92, (40, 40, 42), (20, 20, 20))
    box(picture, 116, 236, 68, 44, (70, 84, 96), (140, 140, 140))
    for x in (118, 138, 158, 178):
        cv2.circle(picture, (x, 220), 5, (200, 200, 210), -1)
    cv2.ellipse(picture, (130, 184), (26, 8), 0, 0, 360, (20, 20, 20), -1)
    cv2.line(picture, (154, 182), (196, 170), (30, 30, 30), 5)
    cv2.circle(picture, (340, 168), 22, (40, 60, 210), -1)
    cv2.circle(picture, (368, 176), 14, (50, 190, 90), -1)
    return picture


def yard() -> Picture:
    """A brick house, a tree, a path, a bicycle."""
    picture = canvas((232, 206, 164))
    box(picture, 0, 200, 400, 100, (74, 128, 92))
    polygon(picture, [(120, 300), (260, 300), (205, 200), (180, 200)], (150, 164, 172))
    box(picture, 150, 60, 250, 142, (66, 84, 150))
    for y in range(60, 202, 8):
        cv2.line(picture, (150, y), (400, y), (96, 116, 172), 1)
        for x in range(150 + (y // 8 % 2) * 8, 400, 16):
            cv2.line(picture, (x, y), (x, y + 8), (96, 116, 172), 1)
    polygon(picture, [(140, 60), (410, 60), (380, 20), (170, 20)], (52, 54, 70))
    for x in (170, 240, 345):
        for y in (78, 140):
            box(picture, x, y, 34, 42, (180, 160, 110), (240, 240, 240))
            cv2.line(picture, (x + 17, y), (x + 17, y + 42), (240, 240, 240), 2)
    box(picture, 292, 140, 36, 62, (40, 70, 40), (230, 230, 230))
    box(picture, 56, 110, 20, 130, (40, 62, 84))
    crown = np.random.default_rng(4)
    for _ in range(140):
        x, y = crown.normal((66, 84), (34, 28))
        shade = int(crown.integers(50, 150))
        cv2.circle(picture, (int(x), int(y)), int(crown.integers(4, 12)), (30, shade, 40), -1)
    for x in (250, 300):
        cv2.circle(picture, (x, 246), 22, (20, 20, 20), 3)
    cv2.polylines(
        picture,
        [np.array([(250, 246), (268, 214), (296, 216), (276, 246), (250, 246)], np.int32)],
        False,
        (40, 40, 200),
        3,
    )
    cv2.line(picture, (300, 246), (292, 204), (40, 40, 200), 3)
    return picture


def street() -> Picture:
    """A row of houses under a dark sky, a road, a car: a place that is never enrolled."""
    picture = canvas((96, 74, 60))
    for index, (x, width) in enumerate(((0, 70), (70, 90), (160, 60), (220, 100), (320, 80))):
        height = (120, 160, 100, 150, 130)[index]
        colour = ((90, 120, 190), (130, 130, 140), (80, 150, 170), (150, 120, 100), (70, 90, 130))[index]
        box(picture, x, 210 - height, width, height, colour, (30, 30, 30))
        for row in range(210 - height + 12, 190, 34):
            for column in range(x + 8, x + width - 16, 24):
                box(picture, column, row, 12, 20, (120, 220, 240) if (row + column) % 3 else (50, 40, 40))
    box(picture, 0, 210, 400, 90, (70, 70, 72))
    for x in range(10, 400, 60):
        box(picture, x, 256, 34, 5, (220, 220, 220))
    polygon(picture, [(230, 236), (252, 214), (312, 214), (336, 236)], (60, 50, 160))
    box(picture, 214, 236, 140, 24, (60, 50, 160), (20, 20, 60))
    for x in (244, 324):
        cv2.circle(picture, (x, 262), 13, (20, 20, 20), -1)
    return picture


def textured(picture: Picture, seed: int) -> Picture:
    """The fine, fixed structure that real surfaces have."""
    grain = np.random.default_rng(seed).normal(0, 14, (HEIGHT // 2, WIDTH // 2, 1))
    grown = cv2.resize(grain, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)[:, :, None]
    grainy: Picture = np.clip(picture + grown, 0, 255).astype(np.uint8)
    return grainy


def first_look(picture: Picture) -> Picture:
    """The view of the camera on a scene."""
    return picture[RIM:-RIM, RIM:-RIM]


def second_look(picture: Picture, seed: int) -> Picture:
    """The same from a step aside, in other light, with the noise of another exposure."""
    moved = picture[RIM + 4 : HEIGHT - RIM + 4, RIM - 8 : WIDTH - RIM - 8].astype(np.float64)
    noise = np.random.default_rng(seed).normal(0, 5, moved.shape)
    return np.clip(0.8 * moved + 12 + noise, 0, 255).astype(np.uint8)


PLACES: dict[str, Callable[[], Picture]] = {"corridor": corridor, "kitchen": kitchen, "yard": yard}


def save(path: Path, picture: Picture) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


def make_pictures(folder: Path) -> None:
    """Write ``folder/places`` and ``folder/camera``; the same bytes every time."""
    for seed, (name, draw) in enumerate(PLACES.items()):
        scene = textured(draw(), seed)
        save(folder / "places" / f"{name}.jpg", first_look(scene))
        save(folder / "camera" / f"{seed + 1}-{name}.jpg", second_look(scene, seed))
    save(folder / "camera" / "4-street.jpg", first_look(textured(street(), 9)))


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the pictures of the README's tour.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("pictures"))
    folder: Path = parser.parse_args().folder
    make_pictures(folder)
    for path in sorted(folder.glob("*/*.jpg")):
        print(path)


if __name__ == "__main__":
    main()
