"""How far off the turn, the shift and the pose of a query are, and whether their covariance says so.

    python -m benchmarks.geometry.pose [--data ../shared/datasets] [--fitted]

No traverse at hand has measured headings, so there are three kinds of truth.

* Turns: two virtual cameras look at one photograph and are turned against each other by known angles.
* Halls: photographs hang on the walls of halls, in which a camera is moved and turned.  Places stand every two metres,
  queries anywhere between them.  Position and heading are known.
* Traverses: reference i of corridor and lip6_outdoor stands at i metres and looks along the traverse; a query stands in
  the middle of its true references.

The normalized estimation error squared, e^T P^-1 e over the number of its values, is 1 on average if a covariance P is
right, and less if it is careful (Bar-Shalom, Li and Kirubarajan, 2001, section 5.4).  Constants are chosen with
``--fitted`` on photographs of train/, and judged without on those of eval/.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report
from core.frames.images import decode
from core.frames.intrinsics import Intrinsics
from core.frames.preprocessing import Pixels
from core.frames.traverses import SUPPORTED_SUFFIXES, read_ground_truth
from core.geometry.detection import find_keypoints
from core.geometry.pose import RelativeView, relative_view, sighting_of
from core.geometry.verification import verify
from core.judgement.position import BUNDLE_REACH, PoseEstimate, estimate_pose
from core.judgement.priors import decision_slope
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import XFeat, load_xfeat
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question
from core.recognition.recognition import locate
from core.recognition.stages import neighborhood_of
from core.store import Directory
from lab.training.views.augmentation import augment
from service.commands.timing.samples import write_map

Array = NDArray[np.float64]
FITTED = ("train/camvid", "train/facades", "train/tower")
JUDGED = ("eval/lip6_outdoor/reference", "eval/webcams", "eval/corridor/ref")
TURNS = (0, 5, 10, 15, 20, 30)
"""Degrees."""
FIELD, SEEN = 90, 55
"""Degrees: the horizontal field of view that a photograph is taken to have, and that of the virtual cameras."""
SIZE = (240, 180)
PICTURES = 15
"""Photographs of each folder for each turn."""
HALLS = 4
SPACING = 2.0
CANDIDATES = 10
"""Places near the best match that are verified."""


def photographs(folder: Path, count: int) -> list[Pixels]:
    """Evenly chosen photographs of a folder and of those in it."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUPPORTED_SUFFIXES)
    chosen = np.linspace(0, len(paths) - 1, min(count, len(paths))).round().astype(int)
    return [decode(paths[index].read_bytes()) for index in chosen]


def pinhole(width: int, height: int, degrees: float) -> Intrinsics:
    """A camera with a horizontal field of view."""
    focal = width / 2 / np.tan(np.radians(degrees / 2))
    return Intrinsics(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)


CAMERA = pinhole(*SIZE, SEEN)


def rotation(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """From a camera's axes (ahead, left, up) to those of the world, by degrees to the left, down and to the side."""
    made = np.eye(3)
    for axis, degrees in enumerate((roll, pitch, yaw)):
        vector = np.zeros(3)
        vector[axis] = np.radians(degrees)
        made = np.asarray(cv2.Rodrigues(vector)[0], np.float64) @ made
    return made


OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From the optical frame to a camera's axes."""


def turned_view(photograph: Pixels, attitude: Array) -> Pixels:
    """A photograph as a virtual camera sees it, uint8 [180, 240, 3]."""
    height, width = photograph.shape[:2]
    inner = pinhole(width, height, FIELD)
    optical = OPTICAL.T @ attitude @ OPTICAL
    homography = inner.matrix() @ optical @ np.linalg.inv(CAMERA.matrix())
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(photograph, homography, SIZE, flags=flags, borderMode=cv2.BORDER_REFLECT))


@dataclass(frozen=True)
class Errors:
    """Errors, their stated deviations, and the normalized squared errors, each [n]."""

    errors: list[float]
    deviations: list[float]
    normalized: list[float]

    def row(self) -> tuple[float, float, float, float, float]:
        """Root mean square, median, stated, mean normalized error, share within two deviations."""
        errors, said = np.array(self.errors), np.array(self.deviations)
        within = float(np.mean(np.abs(errors) <= 2 * said))
        return (
            float(np.sqrt(np.mean(errors**2))),
            float(np.median(np.abs(errors))),
            float(np.median(said)),
            float(np.mean(self.normalized)),
            within,
        )


def turns(network: XFeat, pictures: Sequence[Pixels], known: bool, seed: int) -> dict[str, Errors]:
    """Errors of the heading's offset for each angle, in degrees."""
    random = np.random.default_rng(seed)
    found = {}
    camera = CAMERA if known else None
    for degrees in TURNS:
        errors = Errors([], [], [])
        for picture in pictures:
            middle = random.uniform(-2, 2, 3)
            sign = random.choice((-1, 1))
            attitudes = [
                rotation(sign * side * degrees / 2 + middle[0], middle[1] * side, middle[2] * side) for side in (-1, 1)
            ]
            views = [turned_view(picture, attitude) for attitude in attitudes]
            query, place = (find_keypoints(network, view) for view in (augment(views[1], random), views[0]))
            view = relative_view(query, place, verify(query, [place])[0], camera, camera)
            if view is not None:
                add_turn(errors, attitudes[0].T @ attitudes[1], view)
        found[f"{degrees}°"] = errors
    return found


def add_turn(errors: Errors, true: Array, view: RelativeView) -> None:
    """Add the error of a turn: in degrees about the vertical, normalized about all axes."""
    vector = cv2.Rodrigues(true @ view.turn.T)[0][:, 0]
    errors.errors.append(float(np.degrees(vector[2])))
    errors.deviations.append(view.heading_spread)
    errors.normalized.append(float(vector @ np.linalg.solve(view.covariance[:3, :3], vector)) / 3)


@dataclass(frozen=True)
class Hall:
    """A hall along x from 0 to its length, with pictures on all six sides; metres."""

    length: float
    width: float
    height: float
    sides: list[Pixels]

    def seen(self, position: Array, attitude: Array) -> Pixels:
        """The picture of a camera, uint8 [180, 240, 3]."""
        columns, rows = 2 * SIZE[0], 2 * SIZE[1]
        x, y = np.meshgrid((np.arange(columns) + 0.5) / 2 - 0.5, (np.arange(rows) + 0.5) / 2 - 0.5)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(CAMERA.matrix()).T
        rays = rays @ (attitude @ OPTICAL).T
        bounds = np.array([[0, self.length], [-self.width / 2, self.width / 2], [0, self.height]])
        picture = np.zeros((rows, columns, 3), np.uint8)
        steep = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
        ends = np.where(steep > 0, bounds[:, 1], bounds[:, 0])
        distance = (ends - position) / steep
        nearest = distance.argmin(axis=-1)
        points = position + rays * np.min(distance, axis=-1, keepdims=True)
        for axis in range(3):
            for upper in (0, 1):
                side = self.sides[2 * axis + upper]
                others = [other for other in range(3) if other != axis]
                shares = [(points[..., o] - bounds[o, 0]) / (bounds[o, 1] - bounds[o, 0]) for o in others]
                across = (shares[0] * side.shape[1]).astype(np.float32)
                down = ((1 - shares[1]) * side.shape[0]).astype(np.float32)
                drawn = cv2.remap(side, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
                mine = (nearest == axis) & ((rays[..., axis] > 0) == bool(upper))
                picture[mine] = drawn[mine]
        return np.asarray(cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA), np.uint8)


def hall(pictures: Sequence[Pixels], random: np.random.Generator) -> Hall:
    """A hall of random size with random photographs, each some metres wide, on its sides."""
    length, width, height = 40.0, float(random.uniform(4, 14)), float(random.uniform(3, 7))

    def side(across: float, down: float) -> Pixels:
        panel = 3.0
        rows = []
        for _ in range(max(1, round(down / panel))):
            row = [
                cv2.resize(pictures[int(random.integers(len(pictures)))], (160, 160))
                for _ in range(round(across / panel))
            ]
            rows.append(np.hstack(row))
        return np.vstack(rows)

    sizes = [(width, height)] * 2 + [(length, height)] * 2 + [(length, width)] * 2
    return Hall(length, width, height, [side(*size) for size in sizes])


@dataclass(frozen=True)
class PosedTraverse:
    """Places and queries with their pictures and poses; x, y and heading in degrees, [n, 3]."""

    places: list[Pixels]
    poses: Array
    queries: list[Pixels]
    true: Array
    camera: Intrinsics | None


def hall_traverse(pictures: Sequence[Pixels], random: np.random.Generator) -> PosedTraverse:
    """Places along the middle of a hall, and queries aside of it, turned and dimmed."""
    made = hall(pictures, random)
    eye = made.height / 2
    places = np.array([(x, random.normal(0, 0.1), random.normal(0, 2)) for x in np.arange(2, 30, SPACING)])
    queries = np.array([(random.uniform(3, 27), random.normal(0, 0.4), random.normal(0, 8)) for _ in range(20)])

    def look(pose: Array) -> Pixels:
        tilt = random.normal(0, 1, 2)
        return made.seen(np.array([pose[0], pose[1], eye]), rotation(pose[2], tilt[0], tilt[1]))

    return PosedTraverse(
        [look(pose) for pose in places], places, [augment(look(pose), random) for pose in queries], queries, CAMERA
    )


def frames_traverse(folder: Path) -> PosedTraverse:
    """A traverse of frames that are a metre apart."""
    names = ("query", "reference") if (folder / "reference").is_dir() else ("query", "ref")
    queries, places = (
        [decode(path.read_bytes()) for path in sorted((folder / name).iterdir()) if path.suffix in SUPPORTED_SUFFIXES]
        for name in names
    )
    truth = read_ground_truth(folder / "ground_truth.csv", len(queries), len(places))
    queried = [number for number, references in enumerate(truth) if len(references)][:: max(1, len(queries) // 110)]
    true = np.array([(float(np.mean(truth[number])), np.nan, np.nan) for number in queried])
    poses = np.array([(number, 0, 0) for number in range(len(places))], np.float64)
    return PosedTraverse(places, poses, [queries[number] for number in queried], true, None)


Found = tuple[Array, PoseEstimate, PoseEstimate | None, PoseEstimate | None]


def estimates(encoder: Encoder, network: XFeat, traverse: PosedTraverse) -> Iterator[Found]:
    """The true pose, and the estimates without views, with views of unknown cameras, and with intrinsics, of each query
    that is recognized near where it was taken."""
    keypoints = [find_keypoints(network, frame) for frame in traverse.places]
    described = [encoder.encode(frame) for frame in traverse.places]
    with tempfile.TemporaryDirectory() as folder:
        poses = [Pose(x=x, y=y, heading=heading % 360) for x, y, heading in traverse.poses]
        enrolments = ((place.descriptor, place.local) for place in described)
        write_map(Path(folder), "poses", encoder, enrolments, fields=lambda index: PlaceFields(pose=poses[index]))
        atlas = Directory(Path(folder))
        map_ = atlas.get("poses")
        answers = locate(map_, encoder, [Query(encoder.encode(frame), Question(k=1)) for frame in traverse.queries])
        reach = neighborhood_of(map_).radius
        for frame, answer, true in zip(traverse.queries, answers, traverse.true, strict=True):
            candidates = answer.candidates
            there = answer.candidates.whereabouts.position[0, 0]
            if answer.pose is None or answer.judgement.verdict != "recognized" or abs(there - true[0]) > reach:
                continue
            query = find_keypoints(network, frame)
            log_odds = decision_slope(answer.calibration) * candidates.ordered.astype(np.float64)
            x = candidates.whereabouts.position[:, 0]
            near = np.flatnonzero(np.abs(x - x[0]) <= BUNDLE_REACH)[:CANDIDATES].tolist()
            numbers = {row: int(np.abs(traverse.poses[:, 0] - x[row]).argmin()) for row in near}
            verified = dict(zip(near, verify(query, [keypoints[number] for number in numbers.values()]), strict=True))
            best = keypoints[numbers[0]]
            views = [relative_view(query, best, verified[0])]
            made = [estimate_pose(candidates.whereabouts, log_odds, reach, views=views), None]
            if (camera := traverse.camera) is not None:
                views = [relative_view(query, best, verified[0], camera, camera)]
                shared = [
                    sighting_of(query, keypoints[numbers[row]], verified[row], camera, camera)
                    if row in verified
                    else None
                    for row in range(near[-1] + 1)
                ]
                made[1] = estimate_pose(candidates.whereabouts, log_odds, reach, views=views, sightings=shared)
            yield true, answer.pose, made[0], made[1]
        atlas.close()


def poses(encoder: Encoder, network: XFeat, traverses: Sequence[PosedTraverse]) -> dict[str, tuple[Errors, Errors]]:
    """Errors of positions in metres (normalized: of x and y, or of x alone), and of headings in degrees."""
    names = ("places", "field of view", "intrinsics")
    found = {name: (Errors([], [], []), Errors([], [], [])) for name in names}
    for traverse in traverses:
        for true, *made in estimates(encoder, network, traverse):
            for name, estimate in zip(names, made, strict=True):
                if estimate is not None:
                    add_pose(*found[name], true, estimate)
    return {name: errors for name, errors in found.items() if errors[0].errors}


def add_pose(positions: Errors, headings: Errors, true: Array, estimate: PoseEstimate) -> None:
    """Add the errors of one estimate."""
    pose, covariance = estimate.pose, estimate.covariance
    assert pose.x is not None and pose.y is not None and pose.heading is not None
    missed = np.array([pose.x - true[0], pose.y - true[1]])
    known = np.isfinite(missed)
    missed, block = missed[known], covariance[:2, :2][np.ix_(known, known)]
    positions.errors.append(float(np.linalg.norm(missed)))
    positions.deviations.append(float(np.sqrt(np.trace(block))))
    positions.normalized.append(float(missed @ np.linalg.solve(block, missed)) / len(missed))
    turn = (pose.heading - true[2] + 180) % 360 - 180
    if np.isfinite(turn):
        headings.errors.append(float(turn))
        headings.deviations.append(float(np.degrees(np.sqrt(covariance[5, 5]))))
        headings.normalized.append(float(np.radians(turn) ** 2 / covariance[5, 5]))


def main(
    data: Annotated[Path, typer.Option(help="Folder of train/ and eval/.")] = Path("../shared/datasets"),
    fitted: Annotated[bool, typer.Option(help="Photographs by which constants are chosen.")] = False,
    halls: Annotated[int, typer.Option(help="How many halls.")] = HALLS,
) -> None:
    """Measure, print a table and write JSON."""
    network, encoder = load_xfeat(), EncoderCatalogue().get(DEFAULT_ENCODER)
    pictures = [picture for name in (FITTED if fitted else JUDGED) for picture in photographs(data / name, PICTURES)]
    rows: list[tuple[str, int, float, float, float, float, float]] = []

    def add(name: str, errors: Errors) -> None:
        if errors.errors:
            rows.append((name, len(errors.errors), *errors.row()))

    for known in (True, False):
        name = "intrinsics" if known else "field of view"
        for angle, errors in turns(network, pictures, known, 1 + fitted).items():
            add(f"turn of {angle}, {name} (°)", errors)
    random = np.random.default_rng(3 + fitted)
    scenes = {"halls": [hall_traverse(pictures, random) for _ in range(halls)]}
    if not fitted:
        scenes |= {name: [frames_traverse(data / "eval" / name)] for name in ("corridor", "lip6_outdoor")}
    for scene, traverses in scenes.items():
        for name, (positions, headings) in poses(encoder, network, traverses).items():
            add(f"{scene}, {name}: position (m)", positions)
            add(f"{scene}, {name}: heading (°)", headings)
    columns = ("", "cases", "root mean square", "median", "stated (median)", "normalized error", "within 2 deviations")
    title = "Turns, shifts and poses on photographs of " + ("train/" if fitted else "eval/")
    figures = {"rows": [dict(zip(columns, row, strict=True)) for row in rows]}
    report("pose-fitted" if fitted else "pose", title, columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
