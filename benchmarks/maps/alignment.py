"""Sequence matching of two traverses: which frames are paired, how many rightly, and what unrelated parts give.

    python -m benchmarks.maps.alignment [--encoder NAME] [--cache FOLDER] [--pieces 30] [--long FRAMES OTHERS]

Corridor, lip6 (truth put right) and two stretches of nordland_tiny, by the scores of the first stage, which the service
uses, and of both.  *Whole*: all queries against all references.
*Nothing shared*: pieces of the queries against the longest run of references of which none is within twelve frames of
a true one; the share of them in which a stretch is found.  *Overlap*: pieces that share 15 to 60 frames and are longer
on one side; the share of the shared frames that is found, and how many of those found are right within three frames.
The cache is that of ``benchmarks.maps.map_sizes``.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.maps.map_sizes import traverses
from benchmarks.report import report
from core.judgement.alignment import of_matrix, shared_stretches
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.threads import share_cores
from lab.training.calibration_quality import widened

Truth = NDArray[np.bool_]
Scores = NDArray[np.float32]
NEAR, FAR = 3, 12


def paired(scores: Scores) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The frames that are paired, int64 [n] each."""
    found = shared_stretches(of_matrix(scores), *scores.shape)
    nothing = np.empty(0, np.int64)
    return np.concatenate([nothing, *(one.first for one in found)]), np.concatenate(
        [nothing, *(one.second for one in found)]
    )


def longest_run(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The longest run of flags that are set, int64."""
    there = np.flatnonzero(flags)
    return max(np.split(there, np.flatnonzero(np.diff(there) > 1) + 1), key=len)


def nothing_shared(scores: Scores, truth: Truth, pieces: int) -> list[bool]:
    """Whether a stretch is found in each of some pairs of pieces that share none."""
    generator, found = np.random.default_rng(0), []
    wide = widened(truth, FAR)
    for _ in range(pieces):
        length = int(generator.integers(25, len(truth) // 2))
        start = int(generator.integers(0, len(truth) - length))
        queried = slice(start, start + length)
        others = longest_run(np.logical_not(np.any(wide[queried], axis=0)))
        found.append(bool(len(paired(scores[queried][:, others])[0])))
    return found


def overlaps(scores: Scores, truth: Truth, pieces: int) -> tuple[list[float], list[float]]:
    """For each of some pairs of pieces that share a part: the share of it that is found, and of the found is right."""
    generator, recall, right = np.random.default_rng(0), [], []
    near = widened(truth, NEAR)
    for _ in range(pieces):
        length = int(generator.integers(15, 60))
        start = int(generator.integers(0, len(truth) - length))
        shown = np.flatnonzero(truth[start + length // 2])
        if not len(shown):
            continue
        first = slice(max(0, start - 40), start + length)
        second = slice(max(0, int(shown[0]) - length // 2), int(shown[0]) + length // 2 + 60)
        true = near[first, second]
        a, b = paired(scores[first, second])
        recall.append(float(np.isin(np.flatnonzero(true.any(axis=1)), a).mean()))
        if len(a):
            right.append(float(true[a, b].mean()))
    return recall, right


def cost(first: int, second: int, values: int = 32) -> dict[str, float]:
    """The cost of matching long traverses of made-up descriptors beside their inner products.

    Args:
        first, second: frames of the two, of which the first is a part of the second.
    """
    generator = np.random.default_rng(0)
    way = generator.normal(size=(second, values)).astype(np.float32)
    seen = way[second // 3 : second // 3 + first] + generator.normal(0, 1, (first, values)).astype(np.float32)
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    found = shared_stretches(lambda rows: lambda columns: seen[rows] @ way[columns].T, first, second)
    seconds = time.process_time() - began
    return {
        "paired": sum(len(one.first) for one in found) / first,
        "nanoseconds_a_pair": 1e9 * seconds / first / second,
        "megabytes": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024,
    }


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
    cache: Annotated[Path | None, typer.Option(help="Folder where the scores are stored.")] = None,
    pieces: Annotated[int, typer.Option(min=1, help="Pairs of pieces of each kind.")] = 30,
    long: Annotated[
        tuple[int, int] | None, typer.Option(help="Instead: the cost for made-up traverses of these lengths.")
    ] = None,
) -> None:
    """Measure and report."""
    share_cores(1)
    if long is not None:
        taken = cost(*long)
        cells = [f"{long[0]} against {long[1]}", *(f"{value:.2f}" for value in taken.values())]
        report("alignment-cost", "the cost of sequence matching", ["frames", *taken], [cells], taken)
        return
    loaded = EncoderCatalogue().get(encoder)
    rows: list[list[Any]] = []
    figures: dict[str, Any] = {"encoder": loaded.identity, "traverses": {}}
    for name, traverse in traverses(loaded, datasets, cache, fitted=True).items():
        if name.startswith("camvid"):
            continue  # it was driven once
        truth = traverse.truth
        for stages, scores in (("first stage", traverse.first), ("both stages", traverse.both)):
            a, b = paired(scores)
            recall, right = overlaps(scores, truth, pieces)
            one = {
                "frames_paired": len(a) / len(truth),
                "right": float(truth[a, b].mean()) if len(a) else None,
                "right_within_3": float(widened(truth, NEAR)[a, b].mean()) if len(a) else None,
                "found_in_nothing_shared": float(np.mean(nothing_shared(scores, truth, pieces))),
                "overlap_found": float(np.mean(recall)),
                "overlap_right": float(np.mean(right)) if right else None,
            }
            figures["traverses"][f"{name}, {stages}"] = one
            cells = ["" if value is None else f"{value:.3f}" for value in one.values()]
            rows.append([f"{name}, {stages}", *cells])
    columns = ["traverse", "paired", "right", "right ± 3", "nothing shared", "overlap found", "overlap right"]
    report("alignment", f"sequence matching, {encoder}", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
