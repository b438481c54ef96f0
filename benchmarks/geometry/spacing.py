"""The errors of poses where the places of a map are far apart, and whether their covariance covers them.

    python -m benchmarks.geometry.spacing [--data ../shared/datasets] [--scene kitti] [--spacings 2,4,6,8,12]
        [--starts 2] [--noise 0,0.5] [--stated no,yes] [--auto]

The frames of kitti_short stand about 1.2 m apart, with measured poses.  Every second, fourth, … of them is a place of a
map, with its x, y and heading and the camera's intrinsics.  The others are asked with ``verify`` ``always``, or
``auto``.  Maps that begin at other frames give more cases.  ``--scene street`` is a rendered street with two bends
(:mod:`benchmarks.geometry.street`), a frame a metre, and queries aside of it.

Each ``--noise`` of the poses of places makes rows.  Where it is ``--stated``, the map has it as its accuracy (what is
usual, where there is none); else pictures estimate it, before the first question.

Only recognized frames have a pose.  The normalized estimation error squared, e^T P^-1 e over the number of its values,
is 1 on average if a covariance P is right, and less if it is careful (Bar-Shalom, Li and Kirubarajan, 2001, section
5.4).
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.geometry.pose import JUDGED, OPTICAL, PICTURES, Errors, add_pose, photographs
from benchmarks.geometry.street import street_traverse
from benchmarks.report import report
from core.frames.images import decode
from core.frames.intrinsics import Intrinsics
from core.frames.preprocessing import Pixels
from core.frames.traverses import find_images
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.judgement.position import PLACE_POSITION
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import load_xfeat
from core.places import PlaceFields, Pose, PoseAccuracy
from core.recognition.pose_survey import pose_survey
from core.recognition.question import Query, Question, Verify
from core.recognition.recognition import describe, locate
from core.store import Directory

Array = NDArray[np.float64]
SPACINGS = "2,4,6,8,12"
CAMERA = "front"
INSIDE = 5.991
"""The squared Mahalanobis distance within which 95 % of errors of two values are."""


@dataclass(frozen=True)
class MeasuredTraverse:
    """Frames whose poses are known.

    poses: x, y and heading in degrees, float64 [n, 3], of the camera.
    mapped: how many of the first frames may be places; where there are no others, those between places are asked.
    """

    frames: list[Pixels]
    encodings: list[Encoding]
    keypoints: list[Keypoints]
    poses: Array
    camera: Intrinsics
    mapped: int


@dataclass(frozen=True)
class SpacingOutcome:
    """The answers at one spacing: for each recognized frame the distance to the best place in metres, and more.

    places: how many places the pose rests on.
    surveys: seconds of a core that each map took to say how exact its poses are, and the metres that it found.
    """

    asked: list[int] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    positions: Errors = field(default_factory=lambda: Errors([], [], []))
    headings: Errors = field(default_factory=lambda: Errors([], [], []))
    sources: list[str] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    surveys: list[tuple[float, float | None]] = field(default_factory=list)

    def row(self) -> dict[str, float]:
        """The figures by the names of the table's columns."""
        return {
            "asked": len(self.asked),
            "recognized": len(self.distances),
            "to the best place (m)": float(np.median(self.distances)),
            "position (m)": float(np.median(self.positions.errors)),
            "stated (m)": float(np.median(self.positions.deviations)),
            "inside 95 %": float(np.mean(2 * np.array(self.positions.normalized) < INSIDE)),
            "normalized, position": float(np.mean(self.positions.normalized)),
            "heading (°)": float(np.median(np.abs(self.headings.errors))),
            "normalized, heading": float(np.mean(self.headings.normalized)),
            "stated (°)": float(np.median(self.headings.deviations)),
            "by geometry": float(np.mean([source == "intrinsics" for source in self.sources])),
            "places": float(np.mean(self.places)),
            "survey (s)": float(np.mean([seconds for seconds, _ in self.surveys])),
        }


def measured_traverse(encoder: Encoder, folder: Path) -> MeasuredTraverse:
    """The traverse in a folder of frames, poses.txt and calib.txt, as KITTI writes them."""
    matrices = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    projection = np.loadtxt(folder / "calib.txt", max_rows=1).reshape(3, 4)
    frames = [decode(path.read_bytes()) for path in find_images(folder)[: len(matrices)]]
    height, width = frames[0].shape[:2]
    camera = Intrinsics(
        width=width,
        height=height,
        fx=projection[0, 0],
        fy=projection[1, 1],
        cx=projection[0, 2],
        cy=projection[1, 2],
    )
    attitudes = OPTICAL @ matrices[:, :, :3] @ OPTICAL.T
    positions = matrices[:, :, 3] @ OPTICAL.T
    headings = np.degrees(np.arctan2(attitudes[:, 1, 0], attitudes[:, 0, 0]))
    poses = np.column_stack([positions[:, :2], headings])
    return described(encoder, frames, poses, camera, len(frames))


def rendered_traverse(encoder: Encoder, data: Path, asked: int) -> MeasuredTraverse:
    """The rendered street with photographs of eval/, and frames that are only asked."""
    pictures = [picture for name in JUDGED for picture in photographs(data / name, PICTURES)]
    made = street_traverse(pictures, np.random.default_rng(4), asked)
    assert made.camera is not None
    poses = np.vstack([made.poses, made.true])
    return described(encoder, [*made.places, *made.queries], poses, made.camera, len(made.places))


def described(
    encoder: Encoder, frames: list[Pixels], poses: Array, camera: Intrinsics, mapped: int
) -> MeasuredTraverse:
    """The traverse of frames, with their descriptors and keypoints."""
    network = load_xfeat()
    encodings = [encoder.encode(frame) for frame in frames]
    return MeasuredTraverse(
        frames, encodings, [find_keypoints(network, frame) for frame in frames], poses, camera, mapped
    )


def outcome(
    encoder: Encoder,
    traverse: MeasuredTraverse,
    spacing: int,
    starts: int,
    when: Verify,
    noise: float = 0.0,
    states: bool = False,
) -> SpacingOutcome:
    """The answers with every ``spacing``-th frame as a place, in maps that begin at several frames.

    Args:
        noise: metres, the deviation of errors of the places' x and of their y.
        states: whether the map states it.
    """
    exact = PoseAccuracy(metres=max(noise, PLACE_POSITION)) if states else None
    found = SpacingOutcome()
    errors = np.random.default_rng(1).normal(0, noise, (len(traverse.poses), 2))
    stated = traverse.poses + np.pad(errors, ((0, 0), (0, 1)))
    for start in np.unique(np.linspace(0, spacing, starts, endpoint=False).astype(int)).tolist():
        with tempfile.TemporaryDirectory() as folder:
            places = list(range(start, traverse.mapped, spacing))
            ask(encoder, traverse, places, stated, exact, Path(folder), when, found)
    return found


def ask(
    encoder: Encoder,
    traverse: MeasuredTraverse,
    places: list[int],
    stated: Array,
    exact: PoseAccuracy | None,
    folder: Path,
    when: Verify,
    found: SpacingOutcome,
) -> None:
    """Add the answers with some frames as places and the others between the first and the last one as queries.

    Args:
        stated: the poses that the places are enrolled with, as those of the traverse.
        exact: how exact the map states them to be.
    """
    atlas = Directory(folder)
    settings = MapSettings(keep="none", pose_accuracy=exact)
    map_ = atlas.create("spaced", encoder.identity, encoder.dimension, settings, encoder.local_shape)
    map_.cameras.put(CAMERA, None, traverse.camera)
    map_.enrol(
        [
            describe(
                map_,
                f"p{number}",
                PlaceFields(pose=pose(stated[number]), camera=CAMERA, sequence="drive"),
                None,
                hashlib.sha256(str(number).encode()).digest(),
                traverse.frames[number],
                traverse.encodings[number],
                keypoints=traverse.keypoints[number],
            )
            for number in places
        ]
    )
    began = time.process_time()
    survey = pose_survey(map_).traverses.values()
    found.surveys.append((time.process_time() - began, next((one.metres for one in survey), None)))
    between = sorted(set(range(places[0], places[-1])) - set(places))
    queries = list(range(traverse.mapped, len(traverse.frames))) or between
    question = Question(k=1, verify=when, camera=CAMERA)
    keypoints = traverse.keypoints
    asked = [Query(traverse.encodings[number], question, partial(keypoints.__getitem__, number)) for number in queries]
    answers = locate(map_, encoder, asked)
    for number, answer in zip(queries, answers, strict=True):
        found.asked.append(number)
        if answer.judgement.verdict == "recognized" and answer.pose is not None:
            best = traverse.poses[int(answer.matches[0][1].id[1:])]
            found.distances.append(float(np.linalg.norm(best[:2] - traverse.poses[number, :2])))
            add_pose(found.positions, found.headings, traverse.poses[number], answer.pose)
            found.sources.append(answer.pose.source)
            found.places.append(answer.pose.places)
    atlas.close()


def pose(values: Array) -> Pose:
    """The pose of x, y and a heading in degrees, float64 [3]."""
    x, y, heading = values.tolist()
    return Pose(x=x, y=y, heading=heading % 360)


def main(
    data: Annotated[Path, typer.Option(help="Folder of eval/.")] = Path("../shared/datasets"),
    scene: Annotated[Literal["kitti", "street"], typer.Option(help="Measured, or rendered with bends.")] = "kitti",
    asked: Annotated[int, typer.Option(min=1, help="Frames that are asked on the rendered street.")] = 60,
    spacings: Annotated[str, typer.Option(help="Frames from place to place, separated by commas.")] = SPACINGS,
    starts: Annotated[int, typer.Option(min=1, help="Maps of each spacing, which begin at different frames.")] = 2,
    noise: Annotated[str, typer.Option(help="Metres, deviations of errors of places' x and y, by commas.")] = "0",
    stated: Annotated[str, typer.Option(help="Whether maps state how exact poses are: no, yes or no,yes.")] = "no",
    auto: Annotated[bool, typer.Option(help="Verify where the scores leave doubt or a pose is wanted.")] = False,
) -> None:
    """Measure, print a table and write JSON."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    folder = data / "eval" / "kitti_short"
    traverse = measured_traverse(encoder, folder) if scene == "kitti" else rendered_traverse(encoder, data, asked)
    when: Verify = "auto" if auto else "always"
    cases = list(product(map(int, spacings.split(",")), map(float, noise.split(",")), stated.split(",")))
    found = {
        (apart, off, says): outcome(encoder, traverse, apart, starts, when, off, says == "yes")
        for apart, off, says in cases
    }
    rows = [
        {"frames apart": apart, "noise (m)": off, "accuracy stated": says, **one.row()}
        for (apart, off, says), one in found.items()
        if one.distances
    ]
    columns = list(rows[0]) if rows else []
    figures = {
        "rows": rows,
        "cases": {
            ", ".join(map(str, case)): {
                "distance": one.distances,
                "error": one.positions.errors,
                "normalized": one.positions.normalized,
                "turn": one.headings.errors,
                "source": one.sources,
                "surveys": one.surveys,
            }
            for case, one in found.items()
        },
    }
    title = f"Poses in maps of {scene} with places far apart"
    name = "_".join(["pose_spacing", scene, *["auto"] * auto])
    report(name, title, columns, [list(row.values()) for row in rows], figures)


if __name__ == "__main__":
    typer.run(main)
