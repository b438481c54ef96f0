"""The errors of poses where the places of a map are far apart, and whether their covariance covers them.

    python -m benchmarks.geometry.spacing [--data ../shared/datasets] [--spacings 2,4,6,8,12] [--starts 2] [--noise 0]
        [--auto]

The frames of kitti_short stand about 1.2 m apart, with measured poses.  Every second, fourth, … of them is a place of a
map, with its x, y and heading and the camera's intrinsics.  The others are asked with ``verify`` ``always``, or
``auto``.  Maps that begin at other frames give more cases.

Only recognized frames have a pose.  The normalized estimation error squared, e^T P^-1 e over the number of its values,
is 1 on average if a covariance P is right, and less if it is careful (Bar-Shalom, Li and Kirubarajan, 2001, section
5.4).
"""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.geometry.pose import OPTICAL, Errors, add_pose
from benchmarks.report import report
from core.frames.images import decode
from core.frames.intrinsics import Intrinsics
from core.frames.preprocessing import Pixels
from core.frames.traverses import find_images
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import load_xfeat
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question, Verify
from core.recognition.recognition import describe, locate
from core.storage import Atlas

Array = NDArray[np.float64]
SPACINGS = "2,4,6,8,12"
CAMERA = "front"


@dataclass(frozen=True)
class MeasuredTraverse:
    """Frames whose poses were measured.

    poses: x, y and heading in degrees, float64 [n, 3], of the camera.
    """

    frames: list[Pixels]
    encodings: list[Encoding]
    keypoints: list[Keypoints]
    poses: Array
    camera: Intrinsics


@dataclass(frozen=True)
class SpacingOutcome:
    """The answers at one spacing: for each recognized frame the distance to the best place in metres, and more.

    places: how many places the pose rests on.
    """

    asked: list[int] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    positions: Errors = field(default_factory=lambda: Errors([], [], []))
    headings: Errors = field(default_factory=lambda: Errors([], [], []))
    sources: list[str] = field(default_factory=list)
    places: list[int] = field(default_factory=list)

    def row(self) -> dict[str, float]:
        """The figures by the names of the table's columns."""
        return {
            "asked": len(self.asked),
            "recognized": len(self.distances),
            "to the best place (m)": float(np.median(self.distances)),
            "position (m)": float(np.median(self.positions.errors)),
            "normalized, position": float(np.mean(self.positions.normalized)),
            "heading (°)": float(np.median(np.abs(self.headings.errors))),
            "normalized, heading": float(np.mean(self.headings.normalized)),
            "stated (m)": float(np.median(self.positions.deviations)),
            "stated (°)": float(np.median(self.headings.deviations)),
            "by geometry": float(np.mean([source == "intrinsics" for source in self.sources])),
            "places": float(np.mean(self.places)),
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
    network = load_xfeat()
    return MeasuredTraverse(
        frames,
        [encoder.encode(frame) for frame in frames],
        [find_keypoints(network, frame) for frame in frames],
        np.column_stack([positions[:, :2], headings]),
        camera,
    )


def outcome(
    encoder: Encoder, traverse: MeasuredTraverse, spacing: int, starts: int, when: Verify, noise: float = 0.0
) -> SpacingOutcome:
    """The answers with every ``spacing``-th frame as a place, in maps that begin at several frames.

    Args:
        noise: metres, the deviation of errors of the places' x and of their y.
    """
    found = SpacingOutcome()
    errors = np.random.default_rng(1).normal(0, noise, (len(traverse.poses), 2))
    stated = traverse.poses + np.pad(errors, ((0, 0), (0, 1)))
    for start in np.unique(np.linspace(0, spacing, starts, endpoint=False).astype(int)).tolist():
        with tempfile.TemporaryDirectory() as folder:
            places = list(range(start, len(traverse.frames), spacing))
            ask(encoder, traverse, places, stated, Path(folder), when, found)
    return found


def ask(
    encoder: Encoder,
    traverse: MeasuredTraverse,
    places: list[int],
    stated: Array,
    folder: Path,
    when: Verify,
    found: SpacingOutcome,
) -> None:
    """Add the answers with some frames as places and the others between the first and the last one as queries.

    Args:
        stated: the poses that the places are enrolled with, as those of the traverse.
    """
    atlas = Atlas(folder)
    settings = MapSettings(keep="none")
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
    queries = sorted(set(range(places[0], places[-1])) - set(places))
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
    spacings: Annotated[str, typer.Option(help="Frames from place to place, separated by commas.")] = SPACINGS,
    starts: Annotated[int, typer.Option(min=1, help="Maps of each spacing, which begin at different frames.")] = 2,
    noise: Annotated[float, typer.Option(help="Metres, the deviation of errors of places' x and y.")] = 0.0,
    auto: Annotated[bool, typer.Option(help="Verify where the scores leave doubt or a pose is wanted.")] = False,
) -> None:
    """Measure, print a table and write JSON."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    traverse = measured_traverse(encoder, data / "eval" / "kitti_short")
    when: Verify = "auto" if auto else "always"
    apart = [int(spacing) for spacing in spacings.split(",")]
    found = {spacing: outcome(encoder, traverse, spacing, starts, when, noise) for spacing in apart}
    rows = [{"frames apart": spacing, **one.row()} for spacing, one in found.items() if one.distances]
    columns = list(rows[0]) if rows else []
    figures = {
        "rows": rows,
        "cases": {
            str(spacing): {
                "distance": one.distances,
                "error": one.positions.errors,
                "normalized": one.positions.normalized,
                "turn": one.headings.errors,
                "source": one.sources,
            }
            for spacing, one in found.items()
        },
    }
    title = "Poses in maps of kitti_short with places far apart"
    report(
        "pose_spacing_auto" if auto else "pose_spacing", title, columns, [list(row.values()) for row in rows], figures
    )


if __name__ == "__main__":
    typer.run(main)
