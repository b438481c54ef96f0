"""How well the estimated pose says where a frame was taken, against the pose of the best match alone.

    python -m benchmarks.poses ../shared/datasets/eval/corridor

The folder has ``query``, ``ref`` and ``ground_truth.csv`` (``query,reference``).  Nobody measured where the frames were
taken, so reference i stands at i metres, and a query in the middle of its true references.  Counted are the queries
that are recognized within REACH metres of that: a wrong place is not the estimate's fault, and is counted elsewhere.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.frames import encode_folder
from benchmarks.report import report
from core.judgement.position import PoseEstimate, estimate_pose
from core.judgement.priors import log_odds_per_score
from core.judgement.verdict import judge
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import METRIC, Neighborhood, Whereabouts
from core.recognition.stages import examine

REACH = 15
NEIGHBORHOOD = Neighborhood(radius=5.0, frames=3)


def true_references(path: Path) -> dict[int, list[int]]:
    """By query."""
    found: dict[int, list[int]] = {}
    with path.open() as file:
        for row in csv.DictReader(file):
            found.setdefault(int(row["query"]), []).append(int(row["reference"]))
    return found


def answered(encoder: Encoder, query: Encoding, places: list[Encoding]) -> tuple[int, PoseEstimate] | None:
    """The best match and the estimate; None unless the query is recognized."""
    n = len(places)
    along = np.column_stack([np.arange(n), np.zeros((n, 2))]).astype(np.float64)
    whereabouts = Whereabouts(np.full(n, METRIC, np.int8), along, np.zeros(n, np.int32), np.arange(n))
    products = np.stack([place.descriptor for place in places]) @ query.descriptor
    scores = encoder.scores_from_inner_products(products)
    first = np.argsort(-scores, kind="stable")
    found = examine(
        scores[first],
        whereabouts.take(first),
        NEIGHBORHOOD,
        encoder.candidates,
        lambda ahead: encoder.agreement(query.local, np.stack([places[row].local for row in first[ahead]])),
    )
    ranked = whereabouts.take(first[found.order])
    calibration = encoder.calibration
    if judge(found.scores, ranked, calibration, NEIGHBORHOOD, found.examined).verdict != "recognized":
        return None
    steepness = log_odds_per_score(calibration, encoder.candidates > 0)
    estimate = estimate_pose(ranked, steepness * found.scores.astype(np.float64), NEIGHBORHOOD.radius)
    assert estimate is not None
    return int(first[found.order[0]]), estimate


def main(folder: Annotated[Path, typer.Argument()]) -> None:
    """Measure, print a table and write JSON."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    queries, places = (encode_folder(encoder, folder / name) for name in ("query", "ref"))
    errors: dict[str, list[float]] = {"best match": [], "estimate": []}
    spreads: list[float] = []
    for index, references in true_references(folder / "ground_truth.csv").items():
        found = answered(encoder, queries[index], places)
        if found is None or abs(found[0] - (middle := float(np.mean(references)))) > REACH:
            continue
        errors["best match"].append(abs(found[0] - middle))
        errors["estimate"].append(abs((found[1].pose.x or 0.0) - middle))
        spreads.append(found[1].spread)
    within = np.array(errors["estimate"]) <= 2 * np.array(spreads)
    figures = {
        name: {"rms": float(np.sqrt(np.mean(np.square(values)))), "mean": float(np.mean(values))}
        for name, values in errors.items()
    }
    rows = [(name, found["rms"], found["mean"]) for name, found in figures.items()]
    rows += [("spread told", float(np.sqrt(np.mean(np.square(spreads)))), float(np.mean(spreads)))]
    title = f"{folder.name}: {len(spreads)} queries recognized; {100 * within.mean():.0f} % within twice the spread"
    more = {"queries": len(spreads), "within_twice_the_spread": float(within.mean()), "errors": figures}
    report(f"poses-{folder.name}", title, ("places apart", "root mean square", "mean"), rows, more)


if __name__ == "__main__":
    typer.run(main)
