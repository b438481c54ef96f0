"""How long one query takes against a map, before any second stage: our snapshot, one plain FAISS index, and NumPy.

    python -m benchmarks.search [--places 100 1622 5000] [--dimension 16384] [--rounds 30] [--json OUT.json]

The three are measured in turns, so that whatever else the machine does falls on all of them alike;
what is shown are medians, and in the JSON the quartiles too.  All three answer with every place,
ranked.  A dead row in twenty shows what forgotten places cost.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import faiss
import numpy as np
from numpy.typing import NDArray

from core.storage.descriptors import ROWS_PER_SEGMENT
from core.storage.snapshot import Snapshot, Spot

Array = NDArray[np.float32]

PAUSE = 0.2
"""Seconds between two measurements: the threads of a BLAS go on spinning for a while after their work."""


def made_up_descriptors(places: int, dimension: int) -> Array:
    """Unit vectors; float32 [places, dimension]."""
    descriptors = np.random.default_rng(0).standard_normal((places, dimension), dtype=np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return descriptors


def snapshot_of(descriptors: Array) -> Snapshot:
    """A map as it is after as many enrolments."""
    snapshot = Snapshot(descriptors.shape[1], ROWS_PER_SEGMENT)
    for row, descriptor in enumerate(descriptors):
        snapshot = snapshot.appended([descriptor], [Spot(0, (0.0, 0.0, 0.0), -1, row)])
    return snapshot


def contenders(descriptors: Array) -> dict[str, Callable[[Array], object]]:
    """What is compared, by name; each takes one query, float32 [D]."""
    places = len(descriptors)
    snapshot = snapshot_of(descriptors)
    forgetful = snapshot.without(list(range(0, places, 20)))
    plain = faiss.IndexFlatIP(descriptors.shape[1])
    plain.add(descriptors)

    def with_numpy(query: Array) -> Array:
        products: Array = descriptors @ query
        ranked: Array = products[np.argsort(-products, kind="stable")]
        return ranked

    expected, found = with_numpy(descriptors[0]), snapshot.search(descriptors[0])[1]
    assert np.allclose(expected, found, atol=1e-5), "the snapshot does not agree with NumPy"
    return {
        "snapshot": snapshot.search,
        "snapshot, 5 % dead": forgetful.search,
        "IndexFlatIP": lambda query: plain.search(query[np.newaxis], places),
        "NumPy": with_numpy,
    }


def measure(runners: dict[str, Callable[[Array], object]], queries: Array, rounds: int) -> dict[str, list[float]]:
    """Milliseconds of every round, by name; the first round is not counted."""
    times: dict[str, list[float]] = {name: [] for name in runners}
    for turn in range(rounds + 1):
        for name, run in runners.items():
            query = queries[turn % len(queries)]
            time.sleep(PAUSE)
            start = time.perf_counter()
            run(query)
            elapsed = 1000 * (time.perf_counter() - start)
            if turn:
                times[name].append(elapsed)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description="Time one query against a map.")
    parser.add_argument("--places", type=int, nargs="+", default=[100, 1622, 5000])
    parser.add_argument("--dimension", type=int, default=16384)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    results = []
    print(f"one query, {arguments.dimension} values, {cores} cores, medians of {arguments.rounds} rounds in ms")
    for places in arguments.places:
        descriptors = made_up_descriptors(places, arguments.dimension)
        times = measure(contenders(descriptors), descriptors, arguments.rounds)
        for name, each in times.items():
            low, median, high = statistics.quantiles(each, n=4)
            results.append({"places": places, "name": name, "median": median, "quartiles": [low, high]})
            print(f"{places:>8} places  {name:<20} {median:8.2f}   ({low:.2f} to {high:.2f})")
    if arguments.json:
        about = {"dimension": arguments.dimension, "cores": cores, "machine": platform.machine()}
        arguments.json.write_text(json.dumps({**about, "rounds": arguments.rounds, "milliseconds": results}, indent=2))


if __name__ == "__main__":
    main()
