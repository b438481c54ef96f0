"""Whether more looks make strangers likelier.

    python -m benchmarks.learning.strangers --datasets ../shared/datasets

Each world has a map of most of its places, whose places have 1, 3 or 10 looks: the first, and those of runs in other
conditions.  They are believed from any score on, as looks that people add are, or from their least scores on, as learnt
ones are.  Frames of known places and strangers are asked in every condition, alone and in sessions of a robot with
odometry, which goes through the map and out of it; another robot is elsewhere all the time.  Half of the strangers are
pictures from elsewhere, the others show places of the same way that the map does not have.

Known frames are drawn from the pictures from which looks are drawn, so their recall is that of other light and weather,
not that of another day.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import typer

from benchmarks.learning.conditions import CONDITIONS
from benchmarks.learning.worlds import WORLDS, RobotWorld
from benchmarks.report import report, verdict
from core.belief import NOTHING, OdometryPose, Run, RunOptions, Step, View, evidence_of, view_of
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.judgement.background import GUARD_FACTOR
from core.learning import least_score
from core.learning.cohort import CLEAR
from core.maps import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields, Pose, look_address
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, locate
from core.recognition.stages import neighborhood_of
from core.store import Directory, Map
from service.learning.adoption import graph_of, likeness_of_encodings

LOOKS = (1, 3, 10)
"""Looks of a place, the first included."""

BAR = 0.03
"""At most this share of the strangers may be recognized."""

IN_THE_MAP = 0.75
"""The share of a world's places, the first ones, that its map has."""

STRANGERS = 60
"""Strangers of each kind and condition."""

SCALE = 1.03
"""Of the odometry of a robot."""

ASKED = 100
"""Numbers of the runs that ask begin here."""


class DrawnFrame(NamedTuple):
    """An encoded frame."""

    encoding: Encoding
    keypoints: Keypoints | None
    view: View
    digest: bytes


def frames_of(encoder: Encoder, pictures: Sequence[Pixels], keypoints: bool) -> list[DrawnFrame]:
    """Encode pictures."""
    found = []
    for pixels in pictures:
        encoding = encoder.encode(pixels)
        points = find_keypoints(packaged_xfeat(), pixels, None) if keypoints else None
        found.append(DrawnFrame(encoding, points, view_of(pixels), hashlib.sha256(pixels.tobytes()).digest()))
    return found


class LookRun(NamedTuple):
    """The looks that a run gives the places of the map.

    leasts: from which scores on they are believed; None: the run does not tell.
    """

    condition: str
    frames: Sequence[DrawnFrame]
    leasts: Sequence[float | None]


@dataclass(frozen=True)
class LookedWorld:
    """A world, encoded.

    first: the places of the map.
    runs: that give further looks.
    known: of each condition, frames of the places of the map, with the numbers of these pictures.
    outside: of each condition, frames of places that the map does not have.
    elsewhere: of each condition, frames from elsewhere.
    """

    world: RobotWorld
    first: Sequence[DrawnFrame]
    runs: Sequence[LookRun]
    known: Mapping[str, Sequence[tuple[int, DrawnFrame]]]
    outside: Mapping[str, Sequence[DrawnFrame]]
    elsewhere: Mapping[str, Sequence[DrawnFrame]]


def in_condition(world: RobotWorld, condition: str, run: int) -> list[Pixels]:
    """Pictures from elsewhere in a condition."""
    kind = condition if condition in CONDITIONS else ("night" if "night" in condition else "day")
    height, width = world.first[0].shape[:2]
    every = world.strangers[:: max(1, len(world.strangers) // STRANGERS)][:STRANGERS]
    sized = [np.asarray(cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA), np.uint8) for one in every]
    return [CONDITIONS[kind](pixels, 5000 + number, run) for number, pixels in enumerate(sized)]


def looked(world: RobotWorld, encoder: Encoder) -> LookedWorld:
    """Encode a world."""
    places = round(IN_THE_MAP * len(world.first))
    later = [at for at in range(len(world.right)) if world.right[at].any()]
    later.sort(key=lambda at: float(world.metres[at]))
    showing = [
        min(
            np.flatnonzero(world.right[:, place]).tolist(), key=lambda at: abs(world.metres[at] - world.spacing * place)
        )
        for place in range(places)
        if world.right[:, place].any()
    ]
    known = [at for at in later if world.right[at, :places].any()]
    absent = [at for at in later if not world.right[at, :places].any()][:STRANGERS]

    def pictures(numbers: Sequence[int], condition: str, run: int) -> list[DrawnFrame]:
        return frames_of(encoder, [world.later(at, condition, run) for at in numbers], world.keypoints)

    order = world.conditions[1:] + world.conditions[:1]
    runs = []
    for run in range(1, LOOKS[-1]):
        condition = order[(run - 1) % len(order)]
        made = pictures(showing, condition, run)
        metres = world.metres[showing]
        leasts = [_least(encoder, made, np.abs(metres - metres[at]), at) for at in range(len(made))]
        runs.append(LookRun(condition, made, leasts))
    first = frames_of(encoder, world.first[:places], world.keypoints)
    asked = list(enumerate(world.conditions, start=ASKED))
    return LookedWorld(
        replace(world, first=world.first[:places]),
        first,
        runs,
        {name: list(zip(known, pictures(known, name, run), strict=True)) for run, name in asked},
        {name: pictures(absent, name, run) for run, name in asked},
        {name: frames_of(encoder, in_condition(world, name, run), world.keypoints) for run, name in asked},
    )


def _least(encoder: Encoder, frames: Sequence[DrawnFrame], apart: np.ndarray, at: int) -> float | None:
    """From which score on a look is believed, by the other frames of its run."""
    radius = MapSettings().same_place_radius
    far = apart > GUARD_FACTOR * radius
    beside = ~far & (apart > CLEAR * radius)

    def scores(which: np.ndarray) -> np.ndarray:
        some = [frames[at], *(frames[one] for one in np.flatnonzero(which).tolist())]
        if len(some) == 1:
            return np.zeros(0, np.float32)
        return likeness_of_encodings(encoder, [one.encoding for one in some])

    return least_score(scores(beside), scores(far), encoder.calibration)


def enrolled(one: LookedWorld, encoder: Encoder, atlas: Directory, looks: int, learnt: bool) -> Map:
    """The map with so many looks a place."""
    map_ = atlas.create("world", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    world = one.world

    def enrolment(name: str, frame: DrawnFrame, fields: PlaceFields) -> Enrolment:
        encoding = frame.encoding
        return Enrolment(
            name, fields, encoding.descriptor, len(encoding.regions), frame.digest, encoding.local,
            keypoints=frame.keypoints,
        )  # fmt: skip

    map_.enrol(
        [
            enrolment(f"p{at}", frame, PlaceFields(sequence="first", pose=Pose(x=world.spacing * at, y=0, heading=0)))
            for at, frame in enumerate(one.first)
        ]
    )
    places = [place for place in range(len(one.first)) if world.right[:, place].any()]
    for number, run in enumerate(one.runs[: looks - 1]):
        made = [
            replace(
                enrolment(look_address(f"p{place}", frame.digest.hex()[:16]), frame, PlaceFields()),
                run=f"run-{number}" if learnt else None,
                least=least if learnt else None,
            )
            for place, frame, least in zip(places, run.frames, run.leasts, strict=True)
            if not learnt or least is not None
        ]
        map_.enrol(made)
    return map_


Told = tuple[int | None, DrawnFrame, Answer]
"""The number of the picture that a frame shows, None for a stranger; the frame; and how it was answered alone."""


class QuestionedMap:
    """A map that is asked, alone and by sessions."""

    def __init__(self, one: LookedWorld, map_: Map, encoder: Encoder) -> None:
        self.one, self.map, self.encoder = one, map_, encoder
        self.graph = graph_of(map_)
        self.alive = np.ones(map_.snapshot().rows, np.bool_)

    def told(self, at: int | None, frame: DrawnFrame) -> Told:
        """A frame that is asked alone."""
        points = frame.keypoints
        find = None if points is None else (lambda: points)
        (found,) = locate(self.map, self.encoder, [Query(frame.encoding, Question(k=1), find)])
        return at, frame, found

    def right(self, at: int, place: str) -> bool:
        """Whether a picture shows a place."""
        return bool(self.one.world.right[at, int(place[1:])])

    def session(self, frames: Sequence[Told]) -> Iterator[tuple[int | None, str | None]]:
        """The numbers of the pictures of a run, and the place where it is believed to be after each."""
        random = np.random.default_rng(30)
        session, gone = Run(RunOptions(), self.graph), 0.0
        before, metres = None, 0.0
        for at, frame, answer in frames:
            metres = metres + self.one.world.spacing if at is None else float(self.one.world.metres[at])
            gone += 0.0 if before is None else SCALE * (metres - before) * float(random.normal(1, 0.03))
            before = metres
            pose = OdometryPose(gone, 0.0, 0.0)
            seen = NOTHING if answer.blank else evidence_of(answer, neighborhood_of(self.map))
            motion = None if session.pose is None else session.moved_to(pose, None, None)
            session.advance(seen, Step(odometry=motion), frame.view, pose)
            found = session.estimate(1, self.alive)
            there = found.candidates[0].row if found.verdict == "recognized" else None
            (place,) = [None] if there is None else self.map.places_at([there])
            yield at, None if place is None else place.id


def figures_of(asked: QuestionedMap) -> dict[str, dict[str, int]]:
    """The counts of each condition: frames, right and wrong ones, and strangers that were recognized.

    Alone and, after "session", in runs: through the map and on, through the map and elsewhere, and elsewhere alone.
    """
    found: dict[str, dict[str, int]] = {}
    for condition in asked.one.world.conditions:
        known = [asked.told(*one) for one in asked.one.known[condition]]
        strangers = {
            "elsewhere": [asked.told(None, one) for one in asked.one.elsewhere[condition]],
            "same way": [asked.told(None, one) for one in asked.one.outside[condition]],
        }
        counts = {"frames": len(known), "right": 0, "wrong": 0, "session frames": 2 * len(known)}
        counts |= {"session right": 0, "session wrong": 0}
        for at, _, answer in known:
            if answer.place is not None and at is not None:
                counts["right" if asked.right(at, answer.place.id) else "wrong"] += 1
        for kind, some in strangers.items():
            counts[kind] = len(some)
            counts[f"{kind} recognized"] = sum(answer.place is not None for _, _, answer in some)
            counts[f"session {kind}"] = (2 if kind == "elsewhere" else 1) * len(some)
            counts[f"session {kind} recognized"] = 0
            for run in ([*known, *some], some)[: 2 if kind == "elsewhere" else 1]:
                for at, place in asked.session(run):
                    if place is not None and at is None:
                        counts[f"session {kind} recognized"] += 1
                    elif place is not None and at is not None:
                        counts["session right" if asked.right(at, place) else "session wrong"] += 1
        found[condition] = counts
    return found


SHARES = (
    ("right", "frames"),
    ("wrong", "frames"),
    ("elsewhere recognized", "elsewhere"),
    ("same way recognized", "same way"),
    ("session right", "session frames"),
    ("session wrong", "session frames"),
    ("session elsewhere recognized", "session elsewhere"),
    ("session same way recognized", "session same way"),
)
"""The columns of the table: a count, and of how many."""


def total(conditions: Mapping[str, Mapping[str, int]], part: str, whole: str) -> float:
    """A share over all conditions."""
    return sum(one[part] for one in conditions.values()) / max(sum(one[whole] for one in conditions.values()), 1)


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    worlds: Annotated[str, typer.Option(help="Names with commas.")] = ",".join(WORLDS),
    encoder: Annotated[str, typer.Option(help="Name of the encoder.")] = DEFAULT_ENCODER,
) -> None:
    """Print the table and write the JSON."""
    chosen = EncoderCatalogue().get(encoder)
    rows: list[list[object]] = []
    figures: dict[str, Any] = {"encoder": chosen.identity, "bar": BAR}
    for name in worlds.split(","):
        world = looked(WORLDS[name](datasets), chosen)
        figures[name] = {}
        for learnt in (True, False):
            for looks in LOOKS if learnt else LOOKS[1:]:
                with TemporaryDirectory() as folder:
                    atlas = Directory(Path(folder) / "data")
                    found = figures_of(QuestionedMap(world, enrolled(world, chosen, atlas, looks, learnt), chosen))
                    atlas.close()
                kind = "first" if looks == 1 else "learnt" if learnt else "any score"
                figures[name][f"{looks}, {kind}"] = found
                shares = [total(found, *one) for one in SHARES]
                met = verdict(max(shares[2], shares[6]), BAR)
                rows.append([name, f"{looks}, {kind}", *(f"{share:.3f}" for share in shares), met])
                print(*rows[-1], flush=True)
    columns = ["", "looks", *(part for part, _ in SHARES), "strangers from elsewhere"]
    report("strangers", "Strangers in maps with several looks a place", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
