"""The three tasks that encoders are chosen by, on photographs held out of training.

* ``lip6``: two traverses of a street (eval/lip6_outdoor), recall@1 and AUC-PR by the truth as stated and, since that
  drifts from what the pictures show, by the truth corrected with local features (ground_truth.py).
* ``webcams``: fixed cameras over months (eval/webcams).  Each daytime picture in turn is its
  camera's one reference among 500 frames of lip6; every other picture of the cameras is a query.
* ``night``: cameras of train/day_night held out of training.  One day picture of each camera and
  the 500 distractors are references; queries are the night pictures, shifted sideways by 10–20 %.

The corridor is reported beside them, and nothing is chosen by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from core.method.agreement import Cells
from core.method.encoder import Encoder
from core.recognition.stages import score_matrix
from lab.training.ground_truth import corrected_truth
from lab.training.photographs import DAY_NIGHT, MIXED_CAMERAS, find_photographs, read, split_photographs

Array = NDArray[np.float32]

DISTRACTORS = 500
DAYLIGHT = 70.0
"""Mean grey value above which a webcam picture counts as taken by day."""


@dataclass(frozen=True)
class TraverseTask:
    """Queries against references; truth[q, r] is true where r shows the place of q."""

    queries: list[Pixels]
    references: list[Pixels]
    truth: NDArray[np.bool_]


@dataclass(frozen=True)
class CameraTask:
    """Pictures of fixed cameras, and unrelated distractors.

    camera: int64 [n], the number of each picture's camera.
    reference, query: bool [n], which pictures are references in turn, and which are queries.
    """

    pictures: list[Pixels]
    camera: NDArray[np.int64]
    reference: NDArray[np.bool_]
    query: NDArray[np.bool_]
    distractors: list[Pixels]


def load_traverses(folder: Path, queries: str, references: str) -> TraverseTask:
    """Two traverses of a folder, with a ``ground_truth.csv`` of (query, reference) indices in order of file names."""
    shown = [[read(path) for path in find_photographs(folder / part)] for part in (queries, references)]
    truth = np.zeros((len(shown[0]), len(shown[1])), np.bool_)
    rows = np.loadtxt(folder / "ground_truth.csv", np.int64, delimiter=",", skiprows=1)
    truth[rows[:, 0], rows[:, 1]] = True
    return TraverseTask(shown[0], shown[1], truth)


def with_corrected_truth(task: TraverseTask) -> TraverseTask:
    """The same traverses with the truth corrected by local features."""
    return replace(task, truth=corrected_truth(task.queries, task.references, task.truth))


def load_webcams(folder: Path, distractors: list[Pixels]) -> CameraTask:
    """The fixed cameras of eval/webcams; every daytime picture is a reference in turn."""
    paths = find_photographs(folder)
    pictures = [read(path) for path in paths]
    names = sorted({path.parent.name for path in paths})
    camera = np.array([names.index(path.parent.name) for path in paths])
    day = np.array([picture.mean() > DAYLIGHT for picture in pictures])
    return CameraTask(pictures, camera, day, np.ones(len(paths), np.bool_), distractors)


def load_shifted_nights(train: Path, distractors: list[Pixels], seed: int = 0) -> CameraTask:
    """The held-out day/night cameras: day pictures whole or cut on one side, nights cut on the other."""
    generator = np.random.default_rng(seed)
    held_out = [path for path in split_photographs(train).held_out if path.relative_to(train).parts[0] == DAY_NIGHT]
    paths = [path for path in held_out if path.parent.name not in MIXED_CAMERAS]
    names = sorted({path.parent.name for path in paths})
    pictures = []
    for path in paths:
        picture = read(path)
        cut = int(picture.shape[1] * generator.uniform(0.1, 0.2))
        left = generator.random() < 0.5
        night = path.name.startswith("night")
        pictures.append((picture[:, cut:] if left else picture[:, :-cut]) if night else picture)
    camera = np.array([names.index(path.parent.name) for path in paths])
    day = np.array([path.name.startswith("day") for path in paths])
    return CameraTask(pictures, camera, day, ~day, distractors)


@dataclass(frozen=True)
class ValidationTasks:
    """All three tasks; lip6 with the truth as stated, too."""

    lip6: TraverseTask
    lip6_as_stated: TraverseTask
    webcams: CameraTask
    night: CameraTask


def load_tasks(datasets: Path) -> ValidationTasks:
    """Read the validation pictures into memory."""
    stated = load_traverses(datasets / "eval/lip6_outdoor", "query", "reference")
    distractors = stated.references[:DISTRACTORS]
    cameras = load_webcams(datasets / "eval/webcams", distractors), load_shifted_nights(datasets / "train", distractors)
    return ValidationTasks(with_corrected_truth(stated), stated, *cameras)


@dataclass(frozen=True)
class Encodings:
    """The descriptions of n pictures by an encoder: descriptors float32 [n, D] and local ones int8 [n, C, L]."""

    descriptors: Array
    local: Cells

    def at(self, rows: NDArray[np.int64]) -> Encodings:
        """The encodings of the pictures ``rows``."""
        return Encodings(self.descriptors[rows], self.local[rows])

    def part(self, rows: slice) -> Encodings:
        """The encodings of some of the pictures."""
        return Encodings(self.descriptors[rows], self.local[rows])


def describe(encoder: Encoder, frames: Sequence[Pixels]) -> Encodings:
    """Encode pictures, eight at a time."""
    batches = [frames[start : start + 8] for start in range(0, len(frames), 8)]
    made = [encoding for batch in batches for encoding in encoder.encode_batch(batch)]
    return Encodings(np.stack([one.descriptor for one in made]), np.stack([one.local for one in made]))


def scores(encoder: Encoder, queries: Encodings, references: Encodings) -> Array:
    """The scores that a map of all the references gives, second stage included; float32 [Q, R]."""
    return score_matrix(encoder, queries.descriptors @ references.descriptors.T, queries.local, references.local)


def camera_scores(encoder: Encoder, pictures: Encodings, distractors: Encodings) -> tuple[Array, Array]:
    """The pictures of fixed cameras among themselves, float32 [n, n], and against the distractors, float32 [n, m].

    A map of these tasks holds all distractors and a few of the pictures.  So a picture gains from the second stage
    where fewer distractors than it examines, or screens, were ahead of it.
    """
    among = encoder.scores_from_inner_products(pictures.descriptors @ pictures.descriptors.T)
    far = encoder.scores_from_inner_products(pictures.descriptors @ distractors.descriptors.T)
    if not encoder.candidates:
        return among, far
    raised = np.empty_like(among)
    for index, cells in enumerate(pictures.local):
        gains = encoder.agreement(cells, pictures.local)
        ours, theirs = among[index], far[index]
        examined = _ahead(theirs, ours) < encoder.screened
        if encoder.screened > encoder.candidates:
            first = np.argsort(-theirs, kind="stable")[: encoder.screened]
            rivals = theirs[first] + encoder.promise(cells, distractors.local[first])
            examined &= _ahead(rivals, ours + encoder.promise(cells, pictures.local)) < encoder.candidates
        raised[index] = ours + np.where(examined, gains, 0)
    return raised, scores(encoder, pictures, distractors)


def _ahead(distractors: Array, pictures: Array) -> NDArray[np.int64]:
    """How many distractors score more than each picture; float32 [m] and [n] to int64 [n]."""
    return np.asarray((distractors[:, None] > pictures).sum(axis=0))


def camera_recall(task: CameraTask, among: Array, far: Array) -> float:
    """Mean recall@1 over references in turn and queries.

    In each turn every camera has one reference: the one in turn for its own camera; a query of
    camera c is right if its camera's reference beats all distractors and the other cameras'
    references (each other camera shows its reference of the same rank).

    Args:
        among: float32 [n, n], scores of the pictures among themselves.
        far: float32 [n, m], of the pictures against the distractors.
    """
    best_distractor = far.max(axis=1)
    cameras = np.unique(task.camera)
    ranks = {c: np.flatnonzero((task.camera == c) & task.reference) for c in cameras}
    means = []
    for c in cameras:
        for rank, reference in enumerate(ranks[c]):
            queried = np.flatnonzero((task.camera == c) & task.query & (np.arange(len(among)) != reference))
            rivals = [ranks[o][rank % len(ranks[o])] for o in cameras if o != c and len(ranks[o])]
            beaten = np.maximum(best_distractor[queried], among[np.ix_(queried, rivals)].max(axis=1, initial=-np.inf))
            means.append(float((among[queried, reference] > beaten).mean()))
    return float(np.mean(means))
