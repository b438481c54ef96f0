"""Whether frames are called known, changed or new as they should be, alone and in a run.

    python -m benchmarks.learning.change --datasets ../shared/datasets [--fit]

Each world has a map of most of its places, made on one day.  Some runs on such days make its history.  Then come frames
of known places on another such day (known), of the same places in other conditions (changed), and strangers (new): half
are pictures from elsewhere, half show places of the same way that the map does not have.  Each is judged with the
history and without any.  Then a robot with odometry goes the whole way: a third of it known, a third changed, a third
known, and off the map.

The numbers of the model (``core.judgement.change``) are fitted, with ``--fit``, to worlds of training data alone: a
drive (camvid), facades and scenes in drawn conditions, and fixed cameras by day and night.  Measured are other sets: a
corridor and streets (lip6), walked again, in drawn conditions; a webcam with its own nights; and a railway in summer,
winter and drawn nights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.day.pictures import another_look
from benchmarks.day.walks import METRES
from benchmarks.learning.conditions import CONDITIONS
from benchmarks.learning.worlds import CUTS, WORLDS, RobotWorld, training_cameras
from benchmarks.report import report
from core.belief import NOTHING, OdometryPose, Run, RunOptions, Step, agreement, evidence_of, view_of
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.judgement.change import (
    SHRINKING,
    SUREST,
    ChangeVerdict,
    UsualScore,
    WorldChange,
    change_of,
    difference,
    log_odds_in_map,
)
from core.judgement.probability import sigmoid
from core.maps import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, answer_to_blank, locate
from core.recognition.stages import neighborhood_of
from core.store import Directory, Map
from lab.training.photographs import find_photographs, read
from service.learning.adoption import graph_of

TRUTHS: tuple[ChangeVerdict, ...] = ("known", "changed", "new")
IN_THE_MAP = 0.75
"""The share of a world's places, the first ones, that its map has."""

MOST = 110
"""Frames of each kind."""

RIDGE = 1e-3 * np.array([9, 1, 9, 1, 0.3, 1])
"""By how much each number is drawn to 0."""

HISTORY = 3
"""Runs on days as the map's that make the history."""

AWAY, DRIFT = 20, 1.03
"""Frames of a run that are off the map, and the scale of its odometry."""


@dataclass(frozen=True)
class JudgedFrame:
    """A frame that was answered, and the truth about it.

    odds: the log odds that the best match is right.
    different: the logarithm of its score over the usual one, with the history.
    seen: how many frames that is known from.
    right: whether the best match is right.
    """

    truth: ChangeVerdict
    odds: float
    different: float
    seen: int
    right: bool
    alone: WorldChange
    unaided: WorldChange
    verdict: str


def walked(name: str, folder: Path, strangers: Sequence[Pixels], stride: int) -> RobotWorld:
    """A world of training photographs in order: the map has some, and the robot takes the ones after them.

    Args:
        stride: every so manieth is one of the map.
    """
    paths = find_photographs(folder)[: 2 * stride * MOST]
    first, after = [[read(path) for path in paths[begin::stride]] for begin in (0, 1)]
    number = np.arange(len(after))
    right = np.abs(number[:, None] - np.arange(len(first))) <= 2

    def later(at: int, condition: str, run: int) -> Pixels:
        return CONDITIONS[condition](after[at], at, run)

    return RobotWorld(name, first, later, METRES * (number + 1 / stride), right, tuple(CONDITIONS), strangers)


def pictures_of(folder: Path) -> list[Pixels]:
    """Pictures of a folder, spread over it."""
    paths = find_photographs(folder)
    return [read(path) for path in paths[:: max(1, len(paths) // MOST)][:MOST]]


def photographed(name: str, folder: Path, every: int) -> RobotWorld:
    """A world of unrelated training photographs, each a place: strangers are those that the map does not have.

    Args:
        every: how manieth photograph is taken, where those beside one another may show one place.
    """
    paths = find_photographs(folder)
    chosen = np.random.default_rng(0).permutation(len(paths) // every)[: 2 * MOST] * every
    first = [read(paths[one]) for one in chosen.tolist()]

    def later(at: int, condition: str, run: int) -> Pixels:
        nearer = float(np.random.default_rng((12, at, run)).uniform(-2, 2))
        moved = another_look(first[at], np.random.default_rng((13, at, run)), nearer)
        return CONDITIONS[condition](moved, at, run)

    right = np.eye(len(first), dtype=np.bool_)
    return RobotWorld(name, first, later, METRES * np.arange(len(first)), right, tuple(CONDITIONS), [], spacing=20.0)


TRAINING: dict[str, Callable[[Path], RobotWorld]] = {
    "scenes": lambda data: photographed("scenes", data / "train/scenes15", 1),
    "facades": lambda data: photographed("facades", data / "train/facades", 2),
    "camvid": lambda data: walked("camvid", data / "train/camvid", pictures_of(data / "train/roads"), 2),
    "cameras by day and night": training_cameras,
}
MEASURED: dict[str, Callable[[Path], RobotWorld]] = {name: WORLDS[name] for name in ("corridor", "lip6", "nordland")}
MEASURED["webcam"] = WORLDS["cameras"]


class KnownWorld:
    """A world with the map of most of its places, and the history of a run on the same kind of day."""

    def __init__(self, world: RobotWorld, map_: Map, encoder: Encoder, asked: NDArray[np.int64]) -> None:
        """``asked``: numbers of the later frames that may be asked."""
        self.world, self.map, self.encoder = world, map_, encoder
        self.present = np.asarray(world.right[:, : map_.count_places()].any(axis=1), np.bool_)
        self.asked = asked
        self.usual: dict[str, UsualScore] = {}
        self.whole = UsualScore()

    def answer(self, pixels: Pixels) -> Answer:
        """The answer to a picture alone."""
        encoding = self.encoder.encode(pixels)
        if not len(encoding.regions):
            return answer_to_blank(self.map, self.encoder, encoding)
        question = Question(k=5)
        (found,) = locate(
            self.map,
            self.encoder,
            [Query(encoding, question, lambda: find_keypoints(packaged_xfeat(), pixels, None))],
        )
        return found

    def remember(self, answer: Answer) -> None:
        """Add a recognized frame to the history."""
        if answer.place is not None:
            one = UsualScore(1, float(answer.candidates.scores[0]))
            self.usual[answer.place.id] = self.usual.get(answer.place.id, UsualScore()) + one
            self.whole += one

    def usual_of(self, answer: Answer) -> UsualScore:
        """The usual score of the best match."""
        return self.usual.get(answer.matches[0][1].id, UsualScore()).within(self.whole)

    def seen(self, truth: ChangeVerdict, number: int | None, answer: Answer) -> JudgedFrame | None:
        """A frame with its truth; None for one without a match.

        Args:
            number: of the later frame; None: of a stranger.
        """
        if not answer.matches:
            return None
        score, usual = float(answer.candidates.scores[0]), self.usual_of(answer)
        alone = change_of(answer.judgement, answer.calibration, score, usual)
        unaided = change_of(answer.judgement, answer.calibration, score)
        odds = log_odds_in_map(answer.judgement, answer.calibration)
        assert alone is not None and unaided is not None and odds is not None
        right = number is not None and bool(self.world.right[number, int(answer.matches[0][1].id[1:])])
        different, verdict = difference(score, usual), answer.judgement.verdict
        return JudgedFrame(truth, odds, different, usual.count, right, alone, unaided, verdict)

    def frames(self) -> Iterator[JudgedFrame]:
        """Frames of each kind; the first runs make the history."""
        world, usual_day = self.world, self.world.conditions[0]
        known = [one for one in self.asked.tolist() if self.present[one]]
        absent = [one for one in self.asked.tolist() if not self.present[one]]
        for run in range(1, 1 + HISTORY):
            for number in known:
                self.remember(self.answer(world.later(number, usual_day, run)))
        repeats = max(1, MOST // len(known))
        chosen = known[:: max(1, len(known) // MOST)][:MOST]
        asked: list[tuple[ChangeVerdict, int | None, Pixels]] = []
        for run in range(10, 10 + repeats):
            asked += [("known", one, world.later(one, usual_day, run)) for one in chosen]
        for run, condition in enumerate(world.conditions[1:] * repeats, start=100):
            some = chosen[run % 2 :: 2] if len(world.conditions) > 2 else chosen
            asked += [("changed", one, world.later(one, condition, run)) for one in some]
        asked += [("new", None, one) for one in world.strangers[: MOST // 2]]
        asked += [("new", None, world.later(one, usual_day, 10)) for one in absent[: MOST // 2]]
        for truth, number, pixels in asked:
            found = self.seen(truth, number, self.answer(pixels))
            if found is not None:
                yield found

    def run(self, condition: str, number: int) -> Iterator[tuple[ChangeVerdict, WorldChange]]:
        """The truth of each frame of a run, and what is said; a third of them is in another condition."""
        world, usual_day = self.world, self.world.conditions[0]
        way = [one for one in range(len(world.right)) if self.present[one]]
        way.sort(key=lambda one: float(world.metres[one]))
        third = len(way) // 3
        frames: list[tuple[ChangeVerdict, Pixels, float]] = []
        for at, one in enumerate(way):
            is_changed = third <= at < 2 * third
            pixels = world.later(one, condition if is_changed else usual_day, number)
            frames.append(("changed" if is_changed else "known", pixels, float(world.metres[one])))
        end = frames[-1][2]
        frames += [("new", one, end + world.spacing * (1 + at)) for at, one in enumerate(world.strangers[:AWAY])]
        random = np.random.default_rng((14, number))
        graph, alive = graph_of(self.map), np.ones(self.map.count_places(), np.bool_)
        session, gone, before = Run(RunOptions(), graph), 0.0, frames[0][2]
        for truth, pixels, metres in frames:
            gone += (metres - before) * DRIFT * float(random.normal(1, 0.03))
            before = metres
            pose, answer = OdometryPose(gone, 0.0, 0.0), self.answer(pixels)
            seen = NOTHING if answer.blank else evidence_of(answer, neighborhood_of(self.map))
            motion = None if session.pose is None else session.moved_to(pose, None, None)
            session.advance(seen, Step(odometry=motion), view_of(pixels), pose)
            found = session.estimate(5, alive)
            alone = self.seen(truth, None, answer)
            if alone is not None:
                agreed = agreement(found, int(answer.candidates.rows[0]), graph)
                yield truth, alone.alone.during(found.unknown, agreed)


def enrolled(world: RobotWorld, encoder: Encoder, atlas: Directory, whole: bool) -> Map:
    """The map of a world's first places, or of the whole of it."""
    map_ = atlas.create("world", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    count = len(world.first) if whole else round(IN_THE_MAP * len(world.first))
    made = []
    for place, pixels in enumerate(world.first[:count]):
        encoding = encoder.encode(pixels)
        fields = PlaceFields(sequence="first", pose=Pose(x=world.spacing * place, y=0.0, heading=0.0))
        digest = hashlib.sha256(pixels.tobytes()).digest()
        keypoints = find_keypoints(packaged_xfeat(), pixels, None) if world.keypoints else None
        regions = len(encoding.regions)
        made.append(
            Enrolment(f"p{place}", fields, encoding.descriptor, regions, digest, encoding.local, keypoints=keypoints)
        )
    map_.enrol(made)
    return map_


Stated = Sequence[tuple[ChangeVerdict, WorldChange]]
"""Truths, and what was said."""


def figures_of(found: Stated) -> dict[str, Any]:
    """The shares of each truth that were called known, changed and new, the log loss, and the Brier score.

    Both losses stand beside those of always stating the shares of the truths.
    """
    truth = np.array([[truth == name for name in TRUTHS] for truth, _ in found], np.float64)
    said = np.array([[one.known, one.changed, one.new] for _, one in found])
    called = np.array([[one.verdict == name for name in TRUTHS] for _, one in found], np.float64)
    base = truth.mean(axis=0)
    return {
        "frames": truth.sum(axis=0).astype(int).tolist(),
        "called": (truth.T @ called / np.maximum(truth.sum(axis=0), 1)[:, None]).round(4).tolist(),
        "log loss": float(-np.log(np.clip((said * truth).sum(axis=1), 1e-9, 1)).mean()),
        "log loss of the base rate": float(-(base * np.log(np.clip(base, 1e-9, 1))).sum()),
        "Brier": float(((said - truth) ** 2).sum(axis=1).mean()),
        "Brier of the base rate": float(((base - truth) ** 2).sum(axis=1).mean()),
    }


def fitted(worlds: Sequence[Sequence[JudgedFrame]]) -> list[float]:
    """IN_MAP, AT_HOME, SURE, UNSEEN, USUAL and SEEN under which the truths are most likely, shrunk a little.

    Each kind of frame of each world counts the same, with the history and without.  ``RIDGE`` was chosen by leaving one
    world out at a time.  UNSEEN is 0 at least, so that odds alone never call a frame changed whose match is rather
    right than wrong: in these worlds they do tell, but a world in which everything looks alike is not among these.
    """
    rows, weights = [], []
    for found in worlds:
        truth = np.array([TRUTHS.index(one.truth) for one in found])
        counts = np.bincount(truth, minlength=3)
        for aided in (1.0, 0.0):
            shares = [aided * one.seen / (one.seen + SHRINKING) for one in found]
            values = [[one.odds, one.different, share] for one, share in zip(found, shares, strict=True)]
            rows.append(np.column_stack([np.array(values), truth]))
            weights.append(1 / counts[truth])
    odds, different, share, truth = np.concatenate(rows).T
    weight = np.concatenate(weights)
    weight /= weight.sum()

    def loss(numbers: NDArray[np.float64]) -> float:
        in_map, at_home, sure, unseen, usual, seen = numbers
        there = sigmoid(in_map * odds + at_home)
        same = sigmoid((1 - share) * (sure * odds + unseen) + share * (usual * different + seen))
        same = np.clip(same, *SUREST)
        said = np.stack([there * same, there * (1 - same), 1 - there])
        likely = said[truth.astype(int), np.arange(len(truth))]
        return float(-(weight * np.log(np.clip(likely, 1e-9, 1))).sum() + (RIDGE * numbers**2).sum())

    bounds = [(0, 5), (-10, 10), (0, 5), (0, 10), (0, 40), (-10, 10)]
    found = minimize(loss, [0.5, 0.5, 0.3, 0.0, 5.0, 1.0], bounds=bounds).x
    return [round(float(one), 2) for one in found]


def measured(name: str, world: RobotWorld, encoder: Encoder, runs: bool) -> tuple[list[JudgedFrame], list[list[Any]]]:
    """The frames of a world as they were judged alone, and what was said of those of its runs."""
    with TemporaryDirectory() as folder:
        atlas = Directory(Path(folder) / "data")
        asked = np.arange(len(world.right))
        map_ = enrolled(world, encoder, atlas, whole=name == "webcam")
        place = KnownWorld(world, map_, encoder, asked[-CUTS:] if name == "webcam" else asked)
        found = list(place.frames())
        said = [
            list(place.run(condition, 200 + number))
            for number, condition in enumerate(world.conditions[1:])
            if runs and name != "webcam"
        ]
        atlas.close()
    return found, said


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    fit: Annotated[bool, typer.Option(help="Fit the model to the training data, and say its numbers.")] = False,
) -> None:
    """Print the table and write the JSON."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    if fit:
        worlds = {name: measured(name, made(datasets), encoder, runs=False)[0] for name, made in TRAINING.items()}
        print("IN_MAP, AT_HOME, SURE, UNSEEN, USUAL, SEEN =", fitted(list(worlds.values())))
        for left_out in worlds:
            others = fitted([found for name, found in worlds.items() if name != left_out])
            print(f"without {left_out}: {others}")
        return
    figures: dict[str, Any] = {"encoder": encoder.identity}
    rows = []
    for name, made in MEASURED.items():
        found, runs = measured(name, made(datasets), encoder, runs=True)
        kinds: dict[str, Stated] = {
            "alone, no history": [(one.truth, one.unaided) for one in found],
            "alone": [(one.truth, one.alone) for one in found],
            "in runs": [one for run in runs for one in run],
        }
        figures[name] = {kind: figures_of(stated) for kind, stated in kinds.items() if stated}
        for kind, one in figures[name].items():
            shares = [" ".join(f"{share:.2f}" for share in called) for called in one["called"]]
            losses = [f"{one[loss]:.2f} ({one[f'{loss} of the base rate']:.2f})" for loss in ("log loss", "Brier")]
            rows.append([f"{name}, {kind}", *shares, *losses])
    columns = ["frames", *(f"{truth}: known changed new" for truth in TRUTHS), "log loss (base)", "Brier (base)"]
    report("change", "Frames called known, changed and new", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
