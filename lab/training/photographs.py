"""The photographs that a network is trained on: found, split and cropped, reproducibly by seed."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from lab.training.views.augmentation import augment

Pixels = NDArray[np.uint8]

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}
DAY_NIGHT = "day_night"
MIXED_CAMERAS = {"640x469", "640x471"}
"""Folders of day_night that hold two scenes each."""
REAL_NIGHTS = 0.75
"""How often the student sees a real night when a fixed camera is drawn."""


@dataclass(frozen=True)
class PhotographSplit:
    """Photographs to train on and held-out photographs, as paths."""

    train: tuple[Path, ...]
    held_out: tuple[Path, ...]


def find_photographs(folder: Path) -> tuple[Path, ...]:
    """All images below ``folder``, sorted by path.

    Raises:
        FileNotFoundError: the folder holds no image.
    """
    found = tuple(sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES))
    if not found:
        raise FileNotFoundError(f"no image under {folder}")
    return found


def split_photographs(folder: Path) -> PhotographSplit:
    """Keep out one photograph in fifty by its name's hash, and every third camera of ``day_night``.

    The rule depends on names alone, so every machine and every later stage sees the same split.
    """
    cameras = sorted({path.parent.name for path in folder.glob(f"{DAY_NIGHT}/*/*")})
    held_out_cameras = set(cameras[::3])
    train: list[Path] = []
    held_out: list[Path] = []
    for path in find_photographs(folder):
        relative = path.relative_to(folder)
        if relative.parts[0] == DAY_NIGHT:
            out = relative.parts[1] in held_out_cameras
        else:
            digest = hashlib.sha256(relative.as_posix().encode()).digest()
            out = digest[0] * 256 + digest[1] < 65536 // 50
        (held_out if out else train).append(path)
    return PhotographSplit(tuple(train), tuple(held_out))


def source_weights(paths: tuple[Path, ...], folder: Path) -> NDArray[np.float64]:
    """Probability of drawing each photograph; a source of n photographs has a weight of n^0.7 in all."""
    sources = [path.relative_to(folder).parts[0] for path in paths]
    counts = {source: sources.count(source) for source in set(sources)}
    weights = np.array([counts[source] ** 0.7 / counts[source] for source in sources])
    return weights / weights.sum()


def random_crop(pictures: Sequence[Pixels], side: int, generator: np.random.Generator) -> list[Pixels]:
    """The same crop of each picture, all of one size: 35–100 % of the area, aspect ratio within 3:4–4:3, mirrored
    half the time, resized to side x side."""
    height, width = pictures[0].shape[:2]
    area = height * width * generator.uniform(0.35, 1.0)
    aspect = np.exp(generator.uniform(np.log(3 / 4), np.log(4 / 3)))
    crop_width = int(min(width, max(32, round(np.sqrt(area * aspect)))))
    crop_height = int(min(height, max(32, round(np.sqrt(area / aspect)))))
    top = int(generator.integers(0, height - crop_height + 1))
    left = int(generator.integers(0, width - crop_width + 1))
    mirrored = generator.random() < 0.5
    crops = []
    for pixels in pictures:
        crop = pixels[top : top + crop_height, left : left + crop_width]
        crop = np.asarray(cv2.resize(crop, (side, side), interpolation=cv2.INTER_LINEAR), np.uint8)
        crops.append(np.ascontiguousarray(crop[:, ::-1]) if mirrored else crop)
    return crops


class AugmentedCrops(Dataset[tuple[Pixels, Pixels]]):
    """Pairs (clean crop, the same crop augmented), each side x side x 3 uint8 BGR.

    Of the fixed cameras, most pairs are a crop by day and the same crop of a real night.

    Item i depends on (seed, i) alone, whatever worker draws it, so a resumed run sees what an
    uninterrupted one would have seen.
    """

    def __init__(self, paths: tuple[Path, ...], folder: Path, side: int, seed: int, start: int, stop: int) -> None:
        self.paths = paths
        self.cumulative = np.cumsum(source_weights(paths, folder))
        self.cameras = day_and_night(paths, folder)
        self.side, self.seed, self.start, self.stop = side, seed, start, stop

    def __len__(self) -> int:
        return self.stop - self.start

    def __getitem__(self, item: int) -> tuple[Pixels, Pixels]:
        if not 0 <= item < len(self):
            raise IndexError(item)
        generator = np.random.default_rng((self.seed, self.start + item))
        chosen = min(int(np.searchsorted(self.cumulative, generator.random())), len(self.paths) - 1)
        path = self.paths[chosen]
        days, nights = self.cameras.get(path.parent, ((), ()))
        if days and nights and generator.random() < REAL_NIGHTS:
            # The camera did not move: the teacher sees the day, the student the night.
            day = days[int(generator.integers(len(days)))]
            other = path if path in nights else nights[int(generator.integers(len(nights)))]
            clean, shown = random_crop([read(day), read(other)], self.side, generator)
            return clean, augment(shown, generator) if generator.random() < 0.5 else shown
        (clean,) = random_crop([read(path)], self.side, generator)
        return clean, augment(clean, generator)


def read(path: Path) -> Pixels:
    """One picture, H x W x 3 BGR.

    Raises:
        ValueError: it cannot be decoded.
    """
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError(f"{path} cannot be decoded")
    return np.asarray(pixels, np.uint8)


def day_and_night(paths: Sequence[Path], folder: Path) -> dict[Path, tuple[list[Path], list[Path]]]:
    """The pictures by day and by night of each fixed camera of ``day_night`` among ``paths``."""
    cameras: dict[Path, tuple[list[Path], list[Path]]] = {}
    for path in paths:
        if path.relative_to(folder).parts[0] == DAY_NIGHT and path.parent.name not in MIXED_CAMERAS:
            cameras.setdefault(path.parent, ([], []))[path.name.startswith("night")].append(path)
    return cameras
