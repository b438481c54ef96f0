"""How well the estimated pose says where a frame was taken, against the pose of the best match alone.

    python -m benchmarks.maps.poses ../shared/datasets/eval/corridor

The folder has ``query``, ``ref`` and ``ground_truth.csv`` (``query,reference``).  Nobody measured where the frames were
taken, so reference i stands at i metres, and a query in the middle of its true references.  Counted are the queries
that are recognized within REACH metres of that: a wrong place is not the estimate's fault, and is counted elsewhere.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.frames import encode_folder
from benchmarks.report import report
from core.frames.traverses import read_ground_truth
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, locate
from core.store import Directory
from service.commands.timing.samples import write_map

REACH = 15


def answers(encoder: Encoder, queries: list[Encoding], places: list[Encoding]) -> list[Answer]:
    """The answers of a map on which place i stands at i metres."""
    with tempfile.TemporaryDirectory() as folder:
        described = ((place.descriptor, place.local) for place in places)
        write_map(Path(folder), "poses", encoder, described, fields=lambda index: PlaceFields(pose=Pose(x=index, y=0)))
        atlas = Directory(Path(folder))
        found = locate(atlas.get("poses"), encoder, [Query(query, Question(k=1)) for query in queries])
        atlas.close()
    return found


def main(folder: Annotated[Path, typer.Argument()]) -> None:
    """Measure, print a table and write JSON."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    queries, places = (encode_folder(encoder, folder / name) for name in ("query", "ref"))
    errors: dict[str, list[float]] = {"best match": [], "estimate": []}
    spreads: list[float] = []
    truth = read_ground_truth(folder / "ground_truth.csv", len(queries), len(places))
    for found, references in zip(answers(encoder, queries, places), truth, strict=True):
        if not len(references) or found.judgement.verdict != "recognized" or found.pose is None:
            continue
        middle = float(np.mean(references))
        best = found.matches[0][1].pose
        assert best is not None and best.x is not None
        if abs(best.x - middle) > REACH:
            continue
        errors["best match"].append(abs(best.x - middle))
        errors["estimate"].append(abs((found.pose.pose.x or 0.0) - middle))
        spreads.append(found.pose.spread)
    within = np.array(errors["estimate"]) <= 2 * np.array(spreads)
    figures = {
        name: {"rms": float(np.sqrt(np.mean(np.square(values)))), "mean": float(np.mean(values))}
        for name, values in errors.items()
    }
    rows = [(name, found["rms"], found["mean"]) for name, found in figures.items()]
    rows += [("spread stated", float(np.sqrt(np.mean(np.square(spreads)))), float(np.mean(spreads)))]
    title = f"{folder.name}: {len(spreads)} queries recognized; {100 * within.mean():.0f} % within twice the spread"
    more = {"queries": len(spreads), "within_twice_the_spread": float(within.mean()), "errors": figures}
    report(f"poses-{folder.name}", title, ("places apart", "root mean square", "mean"), rows, more)


if __name__ == "__main__":
    typer.run(main)
