"""Geometric evidence in maps of a few places, where a score has nothing to be compared with: who passes a limit?

    python -m benchmarks.geometry.small_maps

Maps of neighbouring places are cut from corridor and lip6_outdoor.  Known queries have a true place in the map, by the
corrected truth on lip6; strangers are more than eight frames from everything that it holds.  The candidate that the
score and the share of inliers put first passes if its evidence is over the limit.  Nothing is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.geometry.verification import PictureEncoder, Task, traverses
from benchmarks.report import report
from core.geometry.verification import verify
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.recognition.stages import score_matrix
from core.threads import cores, share_cores

SIZES = (1, 2, 5, 10, 30)
LIMITS = (30, 50, 80)
CANDIDATES = 10
WEIGHT = 0.7
"""Of the share of inliers, as benchmarks.geometry.verification chooses it."""
FAR = 8
MAPS, KNOWN, STRANGERS = 6, 15, 25
"""Maps of each size, and queries of each kind on a map, at most."""


@dataclass(frozen=True)
class Answers:
    """The first candidates of n queries: the evidence of each, whether it is true, and whether its query is known."""

    evidence: NDArray[np.float64]
    right: NDArray[np.bool_]
    known: NDArray[np.bool_]

    def passed(self, limit: float) -> tuple[float, float]:
        """The share of strangers that pass, and of known queries that pass and are right."""
        over = self.evidence > limit
        return float(over[~self.known].mean()), float((over & self.right)[self.known].mean())


def thinned(flags: NDArray[np.bool_], most: int) -> list[int]:
    """At most about ``most`` of the numbers that are flagged, evenly."""
    numbers = np.flatnonzero(flags)
    return [int(number) for number in numbers[:: max(1, len(numbers) // most)]]


def answers_of(task: Task, scores: NDArray[np.float32], size: int) -> Answers:
    """Ask maps of ``size`` places along the references."""
    rows: list[tuple[float, bool, bool]] = []
    total = len(task.references)
    for start in np.linspace(0, total - size, MAPS).astype(int):
        retained = np.arange(start, start + size)
        known = np.asarray(task.truth[:, retained].any(axis=1))
        near = np.asarray(task.truth[:, max(0, start - FAR) : start + size + FAR].any(axis=1))
        strangers = np.asarray(~near & task.truth.any(axis=1))
        for query in thinned(known, KNOWN) + thinned(strangers, STRANGERS):
            best = retained[np.argsort(-scores[query, retained], kind="stable")[:CANDIDATES]]
            found = verify(task.queries.keypoints[query], [task.references.keypoints[place] for place in best])
            shares = np.array([one.inlier_share for one in found])
            first = int((scores[query, best] + WEIGHT * shares).argmax())
            rows.append((found[first].evidence, bool(task.truth[query, best[first]]), bool(known[query])))
    evidence, right, kinds = zip(*rows, strict=True)
    return Answers(np.array(evidence), np.array(right), np.array(kinds))


def main(
    datasets: Annotated[Path, typer.Option(help="The folder with eval.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
) -> None:
    """One table: strangers and known queries that pass each limit, by size of map."""
    share_cores(cores())
    chosen = EncoderCatalogue().get(encoder)
    rows: list[tuple[object, ...]] = []
    figures: dict[str, dict[int, dict[int, tuple[float, float]]]] = {}
    for task in traverses(PictureEncoder(chosen), datasets / "eval"):
        ours, theirs = task.queries.encodings, task.references.encodings
        scores = score_matrix(chosen, ours.descriptors @ theirs.descriptors.T, ours.local, theirs.local)
        figures[task.name] = {}
        for size in SIZES:
            made = answers_of(task, scores, size)
            passed = {limit: made.passed(limit) for limit in LIMITS}
            figures[task.name][size] = passed
            counts = f"{(~made.known).sum()} / {made.known.sum()}"
            cells = [f"{strangers:.3f} / {right:.3f}" for strangers, right in passed.values()]
            rows.append((f"{task.name}, {size}", counts, *cells))
    report(
        "geometry_small_maps",
        "strangers that pass / known queries that pass and are right, by the least evidence",
        ["places", "queries", *map(str, LIMITS)],
        rows,
        {"encoder": chosen.identity, "figures": figures},
    )


if __name__ == "__main__":
    typer.run(main)
