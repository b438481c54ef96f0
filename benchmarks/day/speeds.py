"""Sessions that have to learn a robot's speed: recognized frames, right and wrong, at each camera rate.

    python -m benchmarks.day.speeds --datasets ../shared/datasets

A rate is that of the robot's camera to that of the map's traverse: at 10 the robot goes on by a tenth of the map's
frames from one frame to the next, at 0.1 by ten of them.  Robots of the second traverse of corridor and lip6_outdoor
(by the truth put right) go through a map of the first:

* 0.1 and 0.3 leave frames out, from several first ones on; at 3 the map has every third frame alone;
* at 10 nine frames are drawn between two by their optical flow, as a fast camera would see them;
* in reverse the frames come in the opposite order;
* people pass, drawn over a frame that stands still, with the noise of a camera, after a few frames of the way there and
  before a few of the way on; ``cold`` without these.

Single frames are judged by two stages.  ``told`` is a session whose ``advance`` is fixed to the true one.
The bar: a session recognizes at least as many frames rightly as single frames are, and not more wrongly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.maps.sequences import SAME_PLACE
from benchmarks.maps.sessions import FrameEvidence, SequenceMap, Truth
from benchmarks.report import report, verdict
from core.belief import PlaceGraph, Run, RunOptions, Step, Stride, place_graph
from core.frames.preprocessing import Pixels
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import Whereabouts
from lab.training.map_sizes import corridor_and_lip6
from lab.training.validation import TraverseTask, describe

DRAWN = 10
"""Number of frames at ten times the rate for one."""

STRETCHES, LENGTH = 3, 10
"""Stretches of a walk that are seen at ten times the rate, and how many of its frames each has."""

SPOTS, STANDS, WAY = 5, 60, 12
"""Where a robot stands while people pass, for how many frames, and how many frames there are before and after."""


@dataclass(frozen=True)
class PacedDrive:
    """Frames of one robot; the first ``uncounted`` lead to where it is judged.

    advance: by how many of the map's frames it goes on from one to the next; below 0 in reverse.
    """

    looks: Sequence[FrameEvidence]
    advance: float
    uncounted: int = 0


def drawn_between(first: Pixels, second: Pixels, count: int) -> list[Pixels]:
    """``count`` frames from one frame, which is the first of them, on to the next, which is not among them."""
    grey = [cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY) for pixels in (first, second)]
    there, back = (
        np.asarray(cv2.calcOpticalFlowFarneback(one, other, np.zeros((0, 0)), 0.5, 4, 25, 4, 7, 1.5, 0), np.float32)
        for one, other in ((grey[0], grey[1]), (grey[1], grey[0]))
    )
    rows, columns = np.indices(grey[0].shape, np.float32)
    frames = []
    for number in range(count):
        share = np.float32(number / count)
        warped = [
            cv2.remap(
                pixels, columns - by * flow[..., 0], rows - by * flow[..., 1], cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REFLECT,
            )
            for pixels, flow, by in ((first, there, share), (second, back, 1 - share))
        ]  # fmt: skip
        frames.append(cv2.addWeighted(warped[0], float(1 - share), warped[1], float(share), 0))
    return [np.asarray(frame, np.uint8) for frame in frames]


def taken(pixels: Pixels, random: np.random.Generator) -> Pixels:
    """A frame with the noise of a camera, a little more or less light, and compression."""
    noisy = np.clip(pixels * random.uniform(0.97, 1.03) + random.normal(0, 2, pixels.shape), 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def people_passing(pixels: Pixels, count: int, random: np.random.Generator) -> list[Pixels]:
    """One view again and again, before which up to three people go by, each by another way."""
    height, width = pixels.shape[:2]
    people: list[tuple[float, float, Pixels]] = []
    frames = []
    for _ in range(count):
        if len(people) < 3 and random.random() < 0.12:
            broad, tall = max(4, int(random.uniform(0.1, 0.25) * width)), int(random.uniform(0.6, 0.9) * height)
            clothes = cv2.resize(random.integers(20, 200, (8, 4, 3)).astype(np.uint8), (broad, tall))
            pace = random.uniform(0.03, 0.12) * width
            from_left = random.random() < 0.5
            people.append((-broad if from_left else width, pace if from_left else -pace, np.asarray(clothes, np.uint8)))
        frame = pixels.copy()
        for at, _, clothes in people:
            low, high = max(0, int(at)), min(width, int(at) + clothes.shape[1])
            if low < high:
                frame[height - len(clothes) :, low:high] = clothes[:, low - int(at) : high - int(at)]
        people = [(at + pace, pace, clothes) for at, pace, clothes in people if -width < at + pace <= width]
        frames.append(taken(frame, random))
    return frames


def drives(encoder: Encoder, task: TraverseTask) -> Iterator[tuple[str, list[PacedDrive]]]:
    """By the name of each situation: the robots in it."""
    queries, references = describe(encoder, task.queries), describe(encoder, task.references)
    walk = SequenceMap(encoder, references)
    looks = walk.looks(task.queries, queries, task.truth)
    count = len(looks)
    yield "rate 0.1", [PacedDrive(looks[start::10], 10.0) for start in range(0, 10, 2)]
    yield "rate 0.3", [PacedDrive(looks[start::3], 3.0) for start in range(3)]
    yield "rate 1", [PacedDrive(looks, 1.0)]
    yield "reverse", [PacedDrive(looks[::-1], -1.0)]
    yield "reverse, rate 0.3", [PacedDrive(looks[::-1][start::3], -3.0) for start in range(3)]

    retained = np.arange(0, task.truth.shape[1], 3)
    sparse = SequenceMap(encoder, references.at(retained)).looks(task.queries, queries, _around(task.truth, retained))
    yield "rate 3", [PacedDrive(sparse, 1 / 3)]
    yield "reverse, rate 3", [PacedDrive(sparse[::-1], -1 / 3)]

    random, fast = np.random.default_rng(5), []
    for begin in (count * np.arange(1, 1 + STRETCHES) // (STRETCHES + 1)).tolist():
        pictures, truth = [], []
        for number in range(begin, begin + LENGTH):
            drawn = drawn_between(task.queries[number], task.queries[number + 1], DRAWN)
            pictures += [taken(frame, random) for frame in drawn]
            truth += [task.truth[number] | task.truth[number + 1]] * DRAWN
        fast.append(PacedDrive(walk.looks(pictures, describe(encoder, pictures), np.stack(truth)), 1 / DRAWN))
    yield "rate 10", fast
    yield "reverse, rate 10", [PacedDrive(one.looks[::-1], -one.advance) for one in fast]

    warm, cold = [], []
    for spot in (count * np.arange(1, 1 + SPOTS) // (SPOTS + 1)).tolist():
        pictures = people_passing(task.queries[spot], STANDS, random)
        stands = walk.looks(pictures, describe(encoder, pictures), np.repeat(task.truth[[spot]], STANDS, axis=0))
        before, after = looks[max(0, spot - WAY) : spot], looks[spot + 1 : spot + 1 + WAY]
        warm.append(PacedDrive([*before, *stands, *after], 0.0, len(before)))
        cold.append(PacedDrive(stands, 0.0))
    yield "stands, people pass", warm
    yield "stands, people pass, cold", cold


def _around(truth: Truth, retained: NDArray[np.int64]) -> Truth:
    """The truth in a map of every third reference: those next to a true one."""
    wide = truth.copy()
    wide[:, 1:] |= truth[:, :-1]
    wide[:, :-1] |= truth[:, 1:]
    return wide[:, retained]


def walked(places: int) -> PlaceGraph:
    """The graph of a map of one sequence."""
    return place_graph(Whereabouts.along_sequence(np.arange(places)), np.arange(places), places, SAME_PLACE)


def singles(drive: PacedDrive) -> tuple[int, int]:
    """How many frames are recognized alone, rightly and wrongly."""
    found = [bool(look.right[look.best]) for look in drive.looks[drive.uncounted :] if look.verdict == "recognized"]
    return sum(found), len(found) - sum(found)


def followed(drive: PacedDrive, options: RunOptions) -> tuple[int, int]:
    """How many frames a session recognizes, rightly and wrongly."""
    graph = walked(len(drive.looks[0].right))
    run, alive, found = Run(options, graph), np.ones(len(graph), np.bool_), []
    for number, look in enumerate(drive.looks):
        run.advance(look.seen, Step(), look.view)
        estimate = run.estimate(1, alive)
        if number >= drive.uncounted and estimate.verdict == "recognized":
            found.append(bool(look.right[estimate.candidates[0].row]))
    return sum(found), len(found) - sum(found)


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
) -> None:
    """Print the table and keep the figures."""
    chosen = EncoderCatalogue().get(encoder)
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {"encoder": chosen.identity}
    for name, task in corridor_and_lip6(datasets):
        retained = figures[name] = {}
        for situation, robots in drives(chosen, task):
            counted = {
                "single": [singles(one) for one in robots],
                "session": [followed(one, RunOptions()) for one in robots],
                "told": [followed(one, RunOptions(Stride(abs(one.advance), one.advance < 0))) for one in robots],
            }
            frames = sum(len(one.looks) - one.uncounted for one in robots)
            sums = {how: [sum(each) for each in zip(*found, strict=True)] for how, found in counted.items()}
            retained[situation] = {"frames": frames} | sums
            bars = (
                verdict(sums["session"][0], sums["single"][0], at_least=True),
                verdict(sums["session"][1], sums["single"][1]),
            )
            cells = (f"{right}, {wrong}" for right, wrong in sums.values())
            rows.append((f"{name}: {situation}", frames, *cells, *bars))
    columns = ["recognized, right and wrong", "frames", "single frames", "session", "told", "right", "wrong"]
    report("speeds", chosen.name, columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
