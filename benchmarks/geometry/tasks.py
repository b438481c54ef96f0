"""Tasks of place recognition with keypoints: what changes between a query and its place is another thing in each.

Constants are fitted on tasks made of training photographs: nights of the fixed cameras that the encoder was trained on,
whole and cut on one side; hallways of 160 x 120, cut and disturbed; every second frame of a drive, cut and disturbed,
against the others; photographs seen from elsewhere.  They are judged on traverses that nothing was fitted on:
corridor, lip6_outdoor by the corrected truth, webcams, and nights of the cameras that were held out of training.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.maps import MapSettings
from core.method.encoder import Encoder
from core.networks.xfeat import load_xfeat
from core.threads import cores, each
from lab.training.photographs import DAY_NIGHT, MIXED_CAMERAS, find_photographs, read, split_photographs
from lab.training.validation import DAYLIGHT, DISTRACTORS, Encodings, describe, load_traverses, with_corrected_truth
from lab.training.views.augmentation import augment

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Pictures:
    """Frames, encoded; with their keypoints."""

    encodings: Encodings
    keypoints: list[Keypoints]

    def __len__(self) -> int:
        return len(self.keypoints)

    def take(self, numbers: Sequence[int] | NDArray[np.int64]) -> Pictures:
        """Some of them."""
        rows = np.asarray(numbers, np.int64)
        encodings = Encodings(self.encodings.descriptors[rows], self.encodings.local[rows])
        return Pictures(encodings, [self.keypoints[row] for row in rows])

    def and_then(self, more: Pictures) -> Pictures:
        """These, and others behind them."""
        ours, theirs = self.encodings, more.encodings
        joined = Encodings(
            np.concatenate([ours.descriptors, theirs.descriptors]), np.concatenate([ours.local, theirs.local])
        )
        return Pictures(joined, self.keypoints + more.keypoints)


@dataclass(frozen=True)
class Task:
    """Queries against references, of which ``truth[q, r]`` says whether they show one place.

    frames: references that are no farther apart than this many frames are one place.
    kind: of the change between the two; what is fitted counts each kind alike.
    fitted: constants may be chosen on it.
    """

    name: str
    queries: Pictures
    references: Pictures
    truth: Flags
    frames: int
    kind: str
    fitted: bool


class PictureEncoder:
    """Turns frames into what a task needs, with one encoder and one network of keypoints."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder, self.network = encoder, load_xfeat()

    def take(self, frames: Sequence[Pixels]) -> Pictures:
        """Encode frames."""
        found = each(lambda frame: find_keypoints(self.network, frame), frames, cores())
        return Pictures(describe(self.encoder, frames), found)


# Tasks


def zoomed(pixels: Pixels, most: float, size: tuple[int, int], generator: np.random.Generator) -> Pixels:
    """A part of a picture, cut by at most ``most`` of each side, disturbed, in another size."""
    height, width = pixels.shape[:2]
    left = generator.uniform(1 - most, 1)
    rows, columns = int(height * left), int(width * left)
    top, start = int(generator.integers(0, height - rows + 1)), int(generator.integers(0, width - columns + 1))
    part = cv2.resize(pixels[top : top + rows, start : start + columns], size, interpolation=cv2.INTER_AREA)
    return augment(np.asarray(part, np.uint8), generator)


def nights(camera: PictureEncoder, train: Path, distractors: Pictures, held_out: bool) -> list[Task]:
    """One day of each fixed camera and distractors against its nights: whole, and cut by 10 to 25 % on one side."""
    generator = np.random.default_rng(0)
    held_out_paths = set(split_photographs(train).held_out)
    paths = [path for path in find_photographs(train / DAY_NIGHT) if path.parent.name not in MIXED_CAMERAS]
    paths = [path for path in paths if (path in held_out_paths) == held_out]
    days = {path.parent.name: path for path in reversed(paths) if path.name.startswith("day")}
    dark = [path for path in paths if path.name.startswith("night") and path.parent.name in days]
    names = sorted(days)
    truth = np.zeros((len(dark), len(names) + len(distractors)), np.bool_)
    truth[np.arange(len(dark)), [names.index(path.parent.name) for path in dark]] = True
    references = camera.take([read(days[name]) for name in names]).and_then(distractors)
    shown = [read(path) for path in dark]
    cut = []
    for frame in shown:
        columns = int(frame.shape[1] * generator.uniform(0.1, 0.25))
        cut.append(frame[:, columns:] if generator.random() < 0.5 else frame[:, :-columns])
    kind = "held-out" if held_out else "training"
    return [
        Task(f"nights of {kind} cameras", camera.take(shown), references, truth, 0, "night", not held_out),
        Task(f"the same, cut on one side ({kind})", camera.take(cut), references, truth, 0, "night", not held_out),
    ]


def hallways(camera: PictureEncoder, train: Path) -> Task:
    """Hallways of 25 floors that look alike, at 160 x 120; every third frame is queried again, cut and disturbed."""
    generator = np.random.default_rng(1)
    paths = [path for path in find_photographs(train / "tower") if "hallway" in path.name]
    clips = [path.name.partition("_frame")[0] for path in paths]
    size = (160, 120)
    shown = [np.asarray(cv2.resize(read(path), size, interpolation=cv2.INTER_AREA), np.uint8) for path in paths]
    queried = range(0, len(paths), 3)
    queries = camera.take([zoomed(read(paths[index]), 0.3, size, generator) for index in queried])
    truth = [[abs(q - r) <= 1 and clips[q] == clips[r] for r in range(len(paths))] for q in queried]
    return Task("hallways", queries, camera.take(shown), np.array(truth), MapSettings().same_place_frames, "hall", True)


def drive(camera: PictureEncoder, train: Path) -> Task:
    """Every second frame of a drive against the frames between, which are cut and disturbed."""
    generator = np.random.default_rng(2)
    paths = find_photographs(train / "camvid")
    retained, queried = range(0, len(paths), 2), range(1, len(paths), 2)
    queries = camera.take([zoomed(read(paths[index]), 0.35, (320, 240), generator) for index in queried])
    runs = [path.name[:6] for path in paths]
    truth = [[abs(q - r) <= 1 and runs[q] == runs[r] for r in retained] for q in queried]
    references = camera.take([read(paths[index]) for index in retained])
    return Task("drive", queries, references, np.array(truth), MapSettings().same_place_frames, "drive", True)


def webcams(camera: PictureEncoder, folder: Path, distractors: Pictures) -> list[Task]:
    """One daytime picture of each fixed camera and distractors; three times, with different pictures."""
    paths = find_photographs(folder)
    frames = [read(path) for path in paths]
    cameras = np.unique([path.parent.name for path in paths], return_inverse=True)[1]
    day = np.array([frame.mean() > DAYLIGHT for frame in frames])
    pictures = camera.take(frames)
    tasks = []
    for turn in range(3):
        daytime = [np.flatnonzero((cameras == number) & day) for number in range(cameras.max() + 1)]
        retained = np.array([found[turn * len(found) // 3] for found in daytime])
        queried = np.setdiff1d(np.arange(len(paths)), retained)
        truth = np.zeros((len(queried), len(retained) + len(distractors)), np.bool_)
        truth[np.arange(len(queried)), cameras[queried]] = True
        references = pictures.take(retained).and_then(distractors)
        tasks.append(Task("webcams", pictures.take(queried), references, truth, 0, "night", False))
    return tasks


def traverses(camera: PictureEncoder, evaluation: Path) -> tuple[Task, Task]:
    """The streets of lip6_outdoor, and corridor."""
    frames = MapSettings().same_place_frames
    walk = with_corrected_truth(load_traverses(evaluation / "lip6_outdoor", "query", "reference"))
    street = Task("lip6", camera.take(walk.queries), camera.take(walk.references), walk.truth, frames, "walk", False)
    walk = load_traverses(evaluation / "corridor", "query", "ref")
    queries, references = camera.take(walk.queries), camera.take(walk.references)
    return street, Task("corridor", queries, references, walk.truth, frames, "walk", False)


@dataclass(frozen=True)
class CameraMove:
    """Photographs as a camera sees them that was moved and turned in front of them.

    size: of all pictures.
    step: of the photographs, every how many-th is a reference; every second of these is queried.
    strength: of the displacement; 1 turns it by 14 to 35 degrees to one side.
    """

    folder: str
    size: tuple[int, int]
    step: int
    seed: int
    strength: float


DISPLACED = (
    CameraMove("facades", (160, 120), 2, 5, 1.0),
    CameraMove("facades", (240, 180), 2, 15, 0.5),
    CameraMove("roads", (160, 120), 16, 6, 0.8),
    CameraMove("scenes15", (160, 120), 13, 7, 1.0),
    CameraMove("camvid", (240, 180), 3, 8, 0.6),
)
"""Their queries are cut, spotted and lit anew as well (``lab.training.views.augmentation``)."""
SEEN_FROM_ELSEWHERE = (
    CameraMove("facades", (240, 180), 2, 25, 1.1),
    CameraMove("camvid", (200, 150), 3, 28, 1.2),
    CameraMove("tower", (160, 120), 5, 29, 0.9),
    CameraMove("scenes15", (160, 120), 13, 27, 1.1),
)
"""Their queries have other light and noise beside."""


def displaced(camera: PictureEncoder, train: Path, one: CameraMove, disturbed: bool) -> Task:
    """The photographs of a folder against themselves from elsewhere, disturbed much or little."""
    generator = np.random.default_rng(one.seed)
    paths = find_photographs(train / one.folder)[:: one.step]
    shown = [np.asarray(cv2.resize(read(path), one.size, interpolation=cv2.INTER_AREA), np.uint8) for path in paths]
    queried = range(0, len(paths), 2)
    change = augment if disturbed else relit
    frames = [
        change(from_elsewhere(read(paths[index]), generator, one.size, one.strength), generator) for index in queried
    ]
    truth = np.zeros((len(frames), len(paths)), np.bool_)
    truth[np.arange(len(frames)), list(queried)] = True
    kind = "displaced" if disturbed else "viewpoint"
    name = f"{one.folder}, {kind} {one.strength:g}"
    return Task(name, camera.take(frames), camera.take(shown), truth, 0, kind, True)


def from_elsewhere(pixels: Pixels, generator: np.random.Generator, size: tuple[int, int], strength: float) -> Pixels:
    """A photograph, taken for a wall, as a camera sees it that has moved along a circle around its middle."""
    height, width = pixels.shape[:2]
    inner = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1.0]])
    yaw = generator.choice([-1, 1]) * np.radians(generator.uniform(14, 35) * strength)
    turn = np.array([np.radians(generator.uniform(-8, 8)), yaw, np.radians(generator.uniform(-4, 4))])
    nearer = np.exp(generator.uniform(-0.35, 0.25) * strength)
    aside = -0.9 * np.sin(yaw) + generator.uniform(-0.15, 0.15) * strength
    centre = np.array([aside, generator.uniform(-0.08, 0.08), 1 - np.cos(yaw) * nearer])
    homography = inner @ cv2.Rodrigues(turn)[0] @ (np.eye(3) - np.outer(centre, [0, 0, 1.0])) @ np.linalg.inv(inner)
    seen = cv2.warpPerspective(pixels, homography, (width, height), borderMode=cv2.BORDER_REFLECT)
    inside = seen[int(0.05 * height) : int(0.95 * height), int(0.08 * width) : int(0.92 * width)]
    return np.asarray(cv2.resize(inside, size, interpolation=cv2.INTER_AREA), np.uint8)


def relit(pixels: Pixels, generator: np.random.Generator) -> Pixels:
    """A picture in other light, with noise, compressed."""
    lit = pixels * generator.uniform(0.75, 1.25) + generator.uniform(-15, 15) + generator.normal(0, 3, pixels.shape)
    quality = int(generator.integers(50, 95))
    _, coded = cv2.imencode(".jpg", np.clip(lit, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)


def tasks(camera: PictureEncoder, datasets: Path) -> Iterator[Task]:
    """All tasks, those to fit on first."""
    train, evaluation = datasets / "train", datasets / "eval"
    scenes = camera.take([read(path) for path in find_photographs(train / "scenes15")[::9]])
    yield from nights(camera, train, scenes, held_out=False)
    yield hallways(camera, train)
    yield drive(camera, train)
    for many, disturbed in ((DISPLACED, True), (SEEN_FROM_ELSEWHERE, False)):
        for one in many:
            yield displaced(camera, train, one, disturbed)
    street, indoors = traverses(camera, evaluation)
    yield street
    yield indoors
    yield from webcams(camera, evaluation / "webcams", street.references.take(range(DISTRACTORS)))
    yield from nights(camera, train, scenes, held_out=True)
