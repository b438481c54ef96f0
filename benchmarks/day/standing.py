"""Maps of a robot that stood still, or of a camera much faster than the robot: is the place recognized all the same?

    python -m benchmarks.day.standing --datasets ../shared/datasets

Forty neighbouring references of corridor, and as many of lip6_outdoor, are a map.  At five of them the robot stood, and
the map has k looks: the picture with the noise of a camera, a little more or less light, and compression. Its queries
are further looks at the five spots, the frames of the other traverse that show them, and strangers, of the same
traverse (farther than ``FAR`` frames) and of the other environment.  Places have no poses, poses a few decimetres off,
or poses rounded to ten metres.  ``walk`` is the same walk at 25 times the rate, frames between two references made by
optical flow: a thousand frames of a walk of forty seconds.

Three kinds of sessions go over the same answers: of all frames of the other traverse that pass; one that begins at each
spot, of a robot that stands there; and one of the frames of the other traverse that pass each spot.  A spot is
*held* if the last frame of its session is recognized and right.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import cv2
import numpy as np
import typer

from benchmarks.report import report
from core.belief import Run, RunOptions, Step, View, evidence_of, place_graph, view_of
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.maps import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question, Verify
from core.recognition.recognition import Answer, locate
from core.recognition.stages import neighborhood_of
from core.store import Directory, Map
from core.threads import cores, share_cores
from lab.training.map_sizes import corridor_and_lip6
from lab.training.validation import TraverseTask

Poses = Literal["none", "radius", "coarse"]
Environment = Literal["corridor", "lip6"]

LOOKS = (1, 2, 5, 10, 20, 50, 100, 200)
KINDS = (*map(str, LOOKS), "walk")
PLACES, SPOTS = 40, (5, 12, 20, 27, 34)
FROM = {"corridor": 30, "lip6": 120}
"""The first reference of each map."""

FRESH, OTHER, STRANGERS = 5, 3, 30
"""Further looks at a spot, frames of the other traverse that show it, and strangers of either kind, at most."""

FAR, NEAR = 8, 3
METRES, ROUNDED = 1.5, 10.0
RATE = 25


@dataclass(frozen=True)
class Shot:
    """One frame, encoded; ``shows`` are the references that show its place."""

    encoding: Encoding
    keypoints: Keypoints
    view: View
    shows: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Questions:
    """The queries of maps of one traverse.

    fresh: FRESH further looks at each spot, spot by spot.
    run: the frames of the other traverse that pass the map, in their order.
    stretches: the positions in ``run`` of frames that followed one another; the other traverse may pass the map twice.
    passing: the same of the frames that pass each spot, for each time that they do.
    """

    fresh: list[Shot]
    other: list[Shot]
    strangers: list[Shot]
    run: list[Shot]
    stretches: list[list[int]]
    passing: list[list[int]]


class ShotEncoder:
    """Encodes frames and finds their keypoints."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder, self._keypoints = encoder, packaged_xfeat()

    def shot(self, pixels: Pixels, shows: Sequence[int] = ()) -> Shot:
        """One frame."""
        found = find_keypoints(self._keypoints, pixels)
        return Shot(self.encoder.encode(pixels), found, view_of(pixels), frozenset(shows))


def noisy(pixels: Pixels, random: np.random.Generator) -> Pixels:
    """A further look: noise of two to four grey levels, up to 5 % of exposure, JPEG."""
    light = pixels * random.uniform(0.95, 1.05) + random.normal(0, random.uniform(2, 4), pixels.shape)
    quality = int(random.choice([60, 75, 90]))
    _, data = cv2.imencode(".jpg", np.clip(light, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def between(one: Pixels, other: Pixels, count: int) -> list[Pixels]:
    """``count`` frames from one picture towards another, the first included, by optical flow."""
    grey = [cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY) for pixels in (one, other)]
    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = flow.calc(grey[0], grey[1], None), flow.calc(grey[1], grey[0], None)
    height, width = grey[0].shape
    column, row = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    made = []
    for share in np.arange(count) / count:
        moved = [
            cv2.remap(
                pixels,
                column - np.float32(part) * by[..., 0],
                row - np.float32(part) * by[..., 1],
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            for pixels, by, part in ((one, there, share), (other, back, 1 - share))
        ]
        made.append(np.asarray(cv2.addWeighted(moved[0], float(1 - share), moved[1], float(share), 0), np.uint8))
    return made


def pose(poses: Poses, place: int, random: np.random.Generator) -> Pose | None:
    """The pose of a frame at a reference."""
    x = METRES * place
    if poses == "none":
        return None
    return Pose(x=ROUNDED * round(x / ROUNDED), y=0) if poses == "coarse" else Pose(x=x + random.normal(0, 0.2), y=0)


def fill(atlas: Directory, name: str, encoder: Encoder, shots: Sequence[tuple[int, Shot]], poses: Poses) -> Map:
    """A map of frames, each at a reference, in their order."""
    random = np.random.default_rng(7)
    made = atlas.create(name, encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    items = [
        Enrolment(
            id=f"{place:03d}.{number}",
            fields=PlaceFields(sequence="walk", pose=pose(poses, place, random)),
            descriptor=shot.encoding.descriptor,
            local=shot.encoding.local,
            regions=len(shot.encoding.regions),
            digest=hashlib.sha256(f"{number}".encode()).digest(),
            thumbnail=None,
            image=None,
            keypoints=shot.keypoints,
        )
        for number, (place, shot) in enumerate(shots)
    ]
    for start in range(0, len(items), 64):
        made.enrol(items[start : start + 64])
    return made


def answered(map_: Map, encoder: Encoder, shots: Sequence[Shot], verify: Verify) -> list[Answer]:
    """The answers to frames, each a query of its own."""
    question = Question(k=1, verify=verify)
    return [
        locate(map_, encoder, [Query(shot.encoding, question, partial(getattr, shot, "keypoints"))])[0]
        for shot in shots
    ]


def right(shot: Shot, place_id: str) -> bool:
    """Whether a place shows what a frame shows."""
    return int(place_id.partition(".")[0]) in shot.shows


def recognized(shots: Sequence[Shot], answers: Sequence[Answer]) -> int:
    """How many are recognized and right."""
    return sum(one.place is not None and right(shot, one.place.id) for shot, one in zip(shots, answers, strict=True))


@dataclass(frozen=True)
class SessionOutcomes:
    """The outcomes of a session's frames: whether each was recognized rightly (``right``) or wrongly (``wrong``)."""

    right: list[bool]
    wrong: list[bool]


def followed(map_: Map, shots: Sequence[Shot], answers: Sequence[Answer]) -> SessionOutcomes:
    """A session over the answers to frames."""
    snapshot, neighborhood = map_.snapshot(), neighborhood_of(map_)
    graph = place_graph(snapshot.whereabouts, map_.scope().living_rows(), snapshot.rows, neighborhood)
    run, session = Run(RunOptions(), graph), SessionOutcomes([], [])
    for shot, answer in zip(shots, answers, strict=True):
        run.advance(evidence_of(answer, neighborhood), Step(), shot.view)
        found = run.estimate(1, snapshot.alive)
        correct = None
        if found.verdict == "recognized":
            (place,) = map_.places_at([found.candidates[0].row])
            assert place is not None
            correct = right(shot, place.id)
        session.right.append(correct is True)
        session.wrong.append(correct is False)
    return session


def each_of(
    map_: Map, shots: Sequence[Shot], answers: Sequence[Answer], parts: Sequence[Sequence[int]]
) -> list[SessionOutcomes]:
    """A session of its own for each part of the frames, by their positions."""
    return [followed(map_, [shots[at] for at in own], [answers[at] for at in own]) for own in parts if own]


def held(sessions: Sequence[SessionOutcomes]) -> str:
    """How many spots are held, of how many, and how many frames of their sessions are wrong."""
    wrong = sum(sum(one.wrong) for one in sessions)
    return f"{sum(one.right[-1] for one in sessions)} of {len(sessions)}, {wrong}"


def questions(camera: ShotEncoder, name: str, task: TraverseTask, elsewhere: TraverseTask) -> Questions:
    """The queries of the maps of a traverse."""
    random, first = np.random.default_rng(11), FROM[name]
    window = np.arange(first, first + PLACES)

    def near(place: int) -> range:
        return range(place - NEAR, place + NEAR + 1)

    fresh = [
        camera.shot(noisy(task.references[first + spot], random), near(spot)) for spot in SPOTS for _ in range(FRESH)
    ]
    shown = {
        query: sorted({near_one for place in np.flatnonzero(row[window]).tolist() for near_one in near(place)})
        for query, row in enumerate(task.truth)
    }
    at = sorted({int(query) for spot in SPOTS for query in np.flatnonzero(task.truth[:, first + spot])[:OTHER]})
    other = [camera.shot(task.queries[int(query)], shown[int(query)]) for query in at]
    wide = task.truth[:, max(0, first - FAR) : first + PLACES + FAR].any(axis=1)
    apart = np.flatnonzero(~wide & task.truth.any(axis=1))
    pictures = [task.queries[query] for query in apart[:: max(1, len(apart) // STRANGERS)][:STRANGERS]]
    pictures += elsewhere.queries[:: len(elsewhere.queries) // STRANGERS][:STRANGERS]
    passing = [int(query) for query in np.flatnonzero(task.truth[:, window].any(axis=1))]
    run = [camera.shot(task.queries[query], shown[query]) for query in passing]
    at_spot = task.truth[np.ix_(np.array(passing, np.int64), window)]
    spots = [at_spot[:, spot - NEAR : spot + NEAR + 1].any(axis=1) for spot in SPOTS]
    return Questions(
        fresh,
        other,
        [camera.shot(picture) for picture in pictures],
        run,
        stretches(passing, range(len(passing))),
        [one for spot in spots for one in stretches(passing, np.flatnonzero(spot).tolist())],
    )


def stretches(numbers: Sequence[int], positions: Sequence[int]) -> list[list[int]]:
    """Positions, ascending, cut where more than NEAR frames are missing between their numbers."""
    ends = np.flatnonzero(np.diff(np.asarray(numbers)[list(positions)]) > NEAR) + 1
    return [part.tolist() for part in np.split(np.asarray(positions, np.int64), ends)]


def maps_of(
    camera: ShotEncoder, name: Environment, task: TraverseTask, kinds: Sequence[str]
) -> dict[str, list[tuple[int, Shot]]]:
    """The frames of each kind of map, and the reference that each shows."""
    random, first = np.random.default_rng(5), FROM[name]
    references = task.references[first : first + PLACES + 1]
    shots = [camera.shot(pixels) for pixels in references[:PLACES]]
    looks = {spot: [camera.shot(noisy(references[spot], random)) for _ in range(_most(kinds))] for spot in SPOTS}
    maps = {
        kind: [(at, one) for at, own in enumerate(shots) for one in (looks[at][: int(kind)] if at in looks else [own])]
        for kind in kinds
        if kind != "walk"
    }
    if "walk" in kinds:
        maps["walk"] = [
            (at, camera.shot(noisy(pixels, random)))
            for at in range(PLACES)
            for pixels in between(references[at], references[at + 1], RATE)
        ]
    return maps


def _most(kinds: Sequence[str]) -> int:
    return max((int(kind) for kind in kinds if kind != "walk"), default=0)


def measured(encoder: Encoder, map_: Map, ask: Questions, verify: Verify) -> tuple[object, ...]:
    """A row of the table."""
    fresh, other, strangers, run = (
        answered(map_, encoder, some, verify) for some in (ask.fresh, ask.other, ask.strangers, ask.run)
    )
    sessions = each_of(map_, ask.run, run, ask.stretches)
    by_spot = [range(at, at + FRESH) for at in range(0, len(fresh), FRESH)]
    return (
        len(np.unique(map_.snapshot().whereabouts.ordinal)),
        f"{recognized(ask.fresh, fresh)} of {len(fresh)}",
        f"{recognized(ask.other, other)} of {len(other)}",
        f"{recognized(ask.run, run)} of {len(run)}",
        f"{sum(sum(one.right) for one in sessions)}, {sum(sum(one.wrong) for one in sessions)}",
        held(each_of(map_, ask.fresh, fresh, by_spot)),
        held(each_of(map_, ask.run, run, ask.passing)),
        f"{sum(one.place is not None for one in strangers)} of {len(strangers)}",
    )


def chosen(all_: Sequence[Any], some: Sequence[str] | None) -> list[Any]:
    """All, or those that are named."""
    return [one for one in all_ if not some or one in some]


COLUMNS = ("map", "views", "looks", "other", "pass", "session, wrong", "stand", "pass a spot", "strangers")


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
    environment: Annotated[list[str] | None, typer.Option(help="Of: corridor, lip6.")] = None,
    poses: Annotated[list[str] | None, typer.Option(help="Of: none, radius, coarse.")] = None,
    verify: Annotated[list[str] | None, typer.Option(help="Of: never, auto, always.")] = None,
    looks: Annotated[list[str] | None, typer.Option(help="Looks at a spot: 1 to 200, or walk.")] = None,
) -> None:
    """One table: the share recognized rightly, by environment, poses, mode and looks at a spot; of all, or of some."""
    kinds = chosen(KINDS, looks)
    share_cores(cores())
    camera = ShotEncoder(EncoderCatalogue().get(encoder))
    tasks = dict(corridor_and_lip6(datasets))
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {"encoder": camera.encoder.identity, "columns": COLUMNS, "rows": rows}
    for name in chosen(get_args(Environment), environment):
        task = tasks[name]
        maps = maps_of(camera, name, task, kinds)
        ask = questions(camera, name, task, next(one for other, one in tasks.items() if other != name))
        for how in chosen(get_args(Poses), poses):
            for kind, frames in maps.items():
                with tempfile.TemporaryDirectory() as folder:
                    atlas = Directory(Path(folder))
                    map_ = fill(atlas, "stood", camera.encoder, frames, how)
                    for mode in chosen(get_args(Verify), verify):
                        row = (f"{name}, {how}, {mode}, {kind}", *measured(camera.encoder, map_, ask, mode))
                        rows.append(row)
                        print(*row, sep=" | ", flush=True)
                    atlas.close()
    report("standing", "recognized and right; of spots held", COLUMNS, rows, figures)


if __name__ == "__main__":
    typer.run(main)
