"""The gain of following a run: recall@1 of single frames and of the filter; and what it costs.

    python -m benchmarks.maps.sequences --data ../shared/datasets/eval

Three pairs of traverses: lip6_outdoor (by its stated truth, and by the truth put right with local features,
lab/training/ground_truth.py; the bar is half the single frames' errors by the latter), nordland_tiny (within 15 frames;
the bar is a recall@1 of 0.9) and corridor.  Every run is causal: a frame's answer knows only the frames before it.
No motion is given, and no map has poses.  As in a service, the positions of references count views
(``core.maps.views``), and a run sees how much the view has changed.  Beside it, over 5 000 places with poses, the time
that one frame's belief takes, against encoding a frame in the same minute.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report, verdict
from core.belief import (
    Evidence,
    Odometry,
    PlaceGraph,
    Run,
    RunOptions,
    Step,
    Stride,
    View,
    evidence,
    place_graph,
    sighted,
    view_of,
)
from core.frames.images import decode
from core.judgement.verdict import judge
from core.maps import MapSettings
from core.maps.views import MOST_HIDDEN, LatestViews, ViewedFrame
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import METRIC, Neighborhood, Whereabouts
from core.recognition.stages import examine, second_stage
from lab.training.ground_truth import corrected_truth
from lab.training.photographs import find_photographs, read
from lab.training.validation import Encodings, describe
from service.commands.timing.samples import jpeg, sample_frame
from service.commands.timing.stages import medians

Truth = NDArray[np.bool_]

HEAD = 500
SAME_PLACE = Neighborhood(MapSettings().same_place_radius, MapSettings().same_place_frames)
FRAMES = 15
"""Tolerance of nordland_tiny, as is customary."""

TRAVERSES = {
    "lip6_outdoor": ("query", "reference"),
    "nordland_tiny": ("winter", "summer"),
    "corridor": ("query", "ref"),
}
HALVED, RECALL, SHARE = 0.5, 0.9, 0.2


def evidences(
    encoder: Encoder, queries: Encodings, references: Encodings, where: Whereabouts
) -> Iterator[tuple[int, Evidence]]:
    """Of each query in turn: its best reference alone, and what it says of all, both stages as the service has them."""
    for descriptor, local in zip(queries.descriptors, queries.local, strict=True):
        scores = encoder.scores_from_inner_products(references.descriptors @ descriptor)
        rows = np.argsort(-scores, kind="stable")[:HEAD]

        stage = second_stage(encoder, local, references.local[rows].__getitem__)
        found = examine(scores[rows], where.take(rows), SAME_PLACE, *stage)
        ranked = rows[found.order]
        known = (where.take(ranked), encoder.calibration, SAME_PLACE, found.examined)
        yield int(ranked[0]), sighted(evidence(ranked, found.scores, *known), ranked, judge(found.scores, *known))


def positions(references: Encodings) -> NDArray[np.int64]:
    """The position of each frame of a traverse, int64 [n], which counts views."""
    views, found, end = LatestViews(None, {}, min(MOST_HIDDEN, SAME_PLACE.frames)), [], 0
    for descriptor, local in zip(references.descriptors, references.local, strict=True):
        look = ViewedFrame(descriptor, local)
        position = views.position_of(look)
        if position is None:
            position, end = end, end + 1
        views.note(position, look)
        found.append(position)
    return np.array(found, np.int64)


def followed(
    first: list[tuple[int, Evidence]], views: list[View], graph: PlaceGraph, options: RunOptions
) -> list[tuple[int, bool]]:
    """The place believed most after each frame, and whether it is recognized."""
    run, alive, best = Run(options, graph), np.ones(len(graph.index), np.bool_), []
    for (_, seen), view in zip(first, views, strict=True):
        run.advance(seen, Step(), view)
        found = run.estimate(1, alive)
        best.append((found.candidates[0].row, found.verdict == "recognized"))
    return best


def judged(right: Truth, answers: list[tuple[int, bool]], where: Whereabouts) -> dict[str, int]:
    """How many answers are wrong, and of those that are recognized how many are right and wrong.

    A place is right if any frame of its view is.
    """
    same = enumerate(answers)
    found = np.array([right[query, where.ordinal == where.ordinal[best]].any() for query, (best, _) in same])
    recognized = np.array([sure for _, sure in answers])
    sure = {"recognized": int((found & recognized).sum()), "misled": int((~found & recognized).sum())}
    return {"wrong": int((~found).sum())} | sure


def truths(name: str, folder: Path, queries: list[Any], references: list[Any]) -> dict[str, Truth]:
    """The right references, by each truth that there is."""
    if name == "nordland_tiny":
        apart = np.abs(np.arange(len(queries))[:, None] - np.arange(len(references)))
        return {f"±{FRAMES}": apart <= FRAMES}
    stated = np.zeros((len(queries), len(references)), np.bool_)
    rows = np.loadtxt(folder / "ground_truth.csv", np.int64, delimiter=",", skiprows=1)
    stated[rows[:, 0], rows[:, 1]] = True
    if name != "lip6_outdoor":
        return {"stated": stated}
    return {"put right": corrected_truth(queries, references, stated), "stated": stated}


def recalls(encoder: Encoder, name: str, data: Path, frames: int | None = None) -> dict[str, dict[str, Any]]:
    """By each truth of a pair of traverses: queries, and how single frames and sessions are judged.

    One session learns the pace, the other gets it: a frame of the map from each frame to the next.

    Args:
        frames: the number of first frames taken of each traverse; None: all.
    """
    folder = data / name
    queried, known = ([read(path) for path in find_photographs(folder / part)][:frames] for part in TRAVERSES[name])
    references, views = describe(encoder, known), [view_of(frame) for frame in queried]
    where = Whereabouts.along_sequence(positions(references))
    graph = place_graph(where, np.arange(len(known)), len(known), SAME_PLACE)
    first = list(evidences(encoder, describe(encoder, queried), references, where))
    answers = {"single": [(best, False) for best, _ in first]}
    answers["session"] = followed(first, views, graph, RunOptions())
    answers["session, given the pace"] = followed(first, views, graph, RunOptions(Stride()))
    return {
        truth: {"queries": len(queried)} | {how: judged(right, best, where) for how, best in answers.items()}
        for truth, right in truths(name, folder, queried, known).items()
    }


def costs(encoder: Encoder, places: int, rounds: int) -> dict[str, float]:
    """Milliseconds of encoding a frame, and of one frame's belief by each kind of motion; medians in one run."""
    random = np.random.default_rng(0)
    lanes = 1000
    number = np.arange(places)
    position = np.stack([2.0 * (number % lanes), 6.0 * (number // lanes), np.zeros(places)], axis=1)
    where = Whereabouts(np.full(places, METRIC, np.int8), position, (number // lanes).astype(np.int32), number % lanes)
    graph = place_graph(where, number, places, SAME_PLACE)
    alive = np.ones(places, np.bool_)
    background = encoder.calibration.background_mean + encoder.calibration.background_deviation * random.normal(
        size=(rounds + 8, HEAD)
    )
    scores = -np.sort(-background.astype(np.float32), axis=1)
    rows = np.stack([random.permutation(places)[:HEAD] for _ in scores])
    examined = np.arange(HEAD) < (encoder.candidates or 0)
    steps = {
        "sequence": (RunOptions(), Step()),
        "speed limit": (RunOptions(), Step(reach=4.0)),
        "odometry": (RunOptions(), Step(odometry=Odometry(2.0, variance=0.04))),
        "odometry, lag 5": (RunOptions(lag=5), Step(odometry=Odometry(2.0, variance=0.04))),
    }
    data = jpeg(sample_frame(7))
    runs: dict[str, Any] = {"encode": lambda: encoder.encode(decode(data))}
    for name, (options, step) in steps.items():
        run, turns = Run(options, graph), iter(range(len(scores)))

        def advance(run: Run = run, step: Step = step, turns: Iterator[int] = turns) -> None:
            turn = next(turns)
            best = rows[turn]
            seen = evidence(best, scores[turn], where.take(best), encoder.calibration, SAME_PLACE, examined)
            run.advance(seen, step)
            run.estimate(5, alive)
            run.earlier(5, alive)

        runs[name] = advance
    return medians(runs, rounds)


def main(
    data: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets/eval"),
    encoder: str = DEFAULT_ENCODER,
    models: Annotated[
        Path | None, typer.Option(help="Folder of further encoders, such as lab.training.vocabularies keeps.")
    ] = None,
    dataset: Annotated[list[str] | None, typer.Option(help="One of them alone; more than once for several.")] = None,
    places: Annotated[int, typer.Option(min=1000)] = 5000,
    rounds: Annotated[int, typer.Option(min=5)] = 60,
) -> None:
    """Print the table and keep the figures."""
    chosen = EncoderCatalogue(models).get(encoder)
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {"encoder": chosen.identity, "recall": {}, "milliseconds": {}}
    for name in dataset if dataset is not None else list(TRAVERSES):
        figures["recall"][name] = recalls(chosen, name, data)
        for truth, counts in figures["recall"][name].items():
            queries, single = counts["queries"], counts["single"]["wrong"]
            for how in ("single", "session", "session, given the pace"):
                wrong, held = counts[how]["wrong"], ""
                if how == "session" and truth == "put right":
                    held = "errors " + verdict(wrong / single, HALVED)
                elif how == "session" and name == "nordland_tiny":
                    held = verdict(1 - wrong / queries, RECALL, at_least=True)
                sure = "" if how == "single" else f"{counts[how]['recognized']}, {counts[how]['misled']}"
                rows.append((f"{name}, {truth}: {how}", f"{1 - wrong / queries:.3f}", wrong, sure, held))
    times = costs(chosen, places, rounds)
    figures |= {"milliseconds": times, "places": places}
    for name, milliseconds in times.items():
        # Looking back is requested apart, and paid for apart.
        held = "" if name in ("encode", "odometry, lag 5") else verdict(milliseconds / times["encode"], SHARE)
        kind = f"{name}, {places} places" if name != "encode" else "encode"
        rows.append((kind, f"{milliseconds:.2f} ms", "", "", held))
    report("sequences", chosen.name, ["", "recall@1, time", "wrong", "recognized, right and wrong", ""], rows, figures)


if __name__ == "__main__":
    typer.run(main)
