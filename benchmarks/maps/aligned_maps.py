"""Two traverses of one environment in one map, without poses: the verdicts before they are aligned, and after.

    python -m benchmarks.maps.aligned_maps [--encoder NAME] [--cache FOLDER]


The references are one traverse.  *Query visit*: the second one is every other query, and the others query the map.
*Twice*: the second traverse has the pictures of the first, and all queries query the map.  Only queries whose place is
among the references count.  An answer is right if it names a reference within ``same_place_frames`` of a true one, or a
frame of the second traverse that shows such a reference.  ``once`` is a map of the references alone.  ``query:enrol``
would enrol what is ``unknown``.  Maps and their alignment are those of the service: the job writes to a real data
directory.

Corridor, lip6 (truth put right) and two stretches of nordland_tiny; the cache keeps the encodings.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report, verdict
from core.frames.preprocessing import Pixels
from core.maps import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.method.regions import Regions
from core.places import PlaceFields
from core.recognition.question import Query, Question
from core.recognition.recognition import locate
from core.store import Map
from core.threads import share_cores
from lab.training.calibration_quality import widened
from lab.training.map_sizes import STRETCHES, corridor_and_lip6
from lab.training.photographs import find_photographs, read
from lab.training.validation import Encodings, TraverseTask, describe
from service.app.runtime import Runtime
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.upkeep import alignment

Truth = NDArray[np.bool_]
Positions = NDArray[np.int64]
NO_REGIONS = Regions(
    np.empty((0, 4), np.int32),
    np.empty(0, np.float32),
    np.empty(0, np.int32),
    np.empty(0, np.int32),
    np.empty((0, 0), np.float32),
)
LEAST = 0.9
"""Of what one traverse alone gives."""

FIRST, SECOND = "first", "second"


def environments(
    encoder: Encoder, datasets: Path, cache: Path | None
) -> Iterator[tuple[str, Encodings, Encodings, Truth]]:
    """Queries, references and which of these they show, by name."""

    def encoded(name: str, sides: Callable[[], Sequence[list[Pixels]]]) -> tuple[Encodings, Encodings]:
        stored = None if cache is None else cache / f"{name}-{encoder.identity.replace('@', '-')}.npz"
        if stored is not None and stored.is_file():
            with np.load(stored) as read_:
                return Encodings(read_["qd"], read_["ql"]), Encodings(read_["rd"], read_["rl"])
        queries, references = (describe(encoder, side) for side in sides())
        if stored is not None:
            stored.parent.mkdir(parents=True, exist_ok=True)
            both = (queries.descriptors, queries.local, references.descriptors, references.local)
            np.savez(stored, qd=both[0], ql=both[1], rd=both[2], rl=both[3])
        return queries, references

    for name, task in corridor_and_lip6(datasets):
        yield name, *encoded(name, partial(_sides, task)), task.truth
    for start, stop in STRETCHES:
        index = np.arange(stop - start)
        seasons = partial(_seasons, datasets / "eval/nordland_tiny", start, stop)
        yield f"nordland {start}", *encoded(f"nordland {start}", seasons), np.abs(index[:, None] - index) <= 2


def _sides(task: TraverseTask) -> Sequence[list[Pixels]]:
    return task.queries, task.references


def _seasons(folder: Path, start: int, stop: int) -> Sequence[list[Pixels]]:
    return [[read(path) for path in find_photographs(folder / one)[start:stop]] for one in ("winter", "summer")]


def create(runtime: Runtime, map_id: str, encoder: Encoder) -> Map:
    """An empty map."""
    settings = MapSettings(keep="none")
    return runtime.engine.maps.create(map_id, encoder.identity, encoder.dimension, settings, encoder.local_shape)


def _alike(wide: Truth, truth: Truth) -> Truth:
    """Which queries show a place that another query shows, bool [Q, Q]."""
    return np.asarray((wide.astype(np.float32) @ truth.T.astype(np.float32)) > 0)


def enrol(map_: Map, sequence: str, frames: Encodings, numbers: Positions) -> None:
    """Enrol some frames as a traverse; the ids are their numbers."""
    map_.enrol([
        Enrolment(
            f"{sequence}-{number}",
            PlaceFields(sequence=sequence),
            frames.descriptors[number],
            1,
            f"{sequence} {number}".encode().ljust(32),
            frames.local[number],
        )
        for number in numbers.tolist()
    ])  # fmt: skip


def verdicts(
    map_: Map, encoder: Encoder, frames: Encodings, queried: Positions, right: dict[str, Truth]
) -> dict[str, float]:
    """The shares of query frames that are recognized and right, recognized and wrong, ambiguous and unknown.

    Args:
        right: for each traverse bool [frames, its frames], which of its frames show the place of a frame.
    """
    counts = dict.fromkeys(("right", "wrong", "ambiguous", "unknown"), 0)
    for start in range(0, len(queried), 16):
        some = queried[start : start + 16].tolist()
        encodings = [Encoding(frames.descriptors[one], frames.local[one], NO_REGIONS, {}) for one in some]
        queries = [Query(one, Question(k=1)) for one in encodings]
        for number, answer in zip(some, locate(map_, encoder, queries), strict=True):
            kind: str = answer.judgement.verdict
            if kind == "recognized":
                assert answer.place is not None
                sequence, _, shown = answer.place.id.rpartition("-")
                kind = "right" if right[sequence][number, int(shown)] else "wrong"
            counts[kind] += 1
    return {kind: count / len(queried) for kind, count in counts.items()}


def align(runtime: Runtime, map_id: str) -> dict[str, Any]:
    """Align the second traverse with the first by the service's job; its result."""
    arguments = {"sequence": SECOND, "with": None, "poses": True, "dry_run": False}
    job = runtime.jobs.submit(alignment.KIND, map_id, arguments=arguments)
    while not (ended := runtime.jobs.get(job.id)).ended:
        time.sleep(0.05)
    assert ended.result is not None, ended.problem
    return dict(ended.result)


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with eval/.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
    cache: Annotated[Path | None, typer.Option(help="Folder where the encodings are stored.")] = None,
) -> None:
    """Measure and report."""
    share_cores(1)
    loaded = EncoderCatalogue().get(encoder)
    rows: list[list[Any]] = []
    figures: dict[str, Any] = {"encoder": loaded.identity, "environments": {}}
    with tempfile.TemporaryDirectory() as folder:
        runtime = Runtime(Settings(data_dir=Path(folder)), Metrics())
        runtime.jobs.start()
        for number, (name, queries, references, truth) in enumerate(environments(loaded, datasets, cache)):
            frames = MapSettings().same_place_frames
            wide = widened(truth, frames)
            known, even = np.flatnonzero(truth.any(axis=1)), np.arange(0, len(truth), 2)
            layouts = {
                # The second traverse is of the same visit as the queries, between whose frames it lies.
                "query visit": (queries, even, known[known % 2 == 1], _alike(wide, truth)),
                # The second traverse is of the same visit as the first, as if the robot had stood twice at each place.
                "twice": (references, np.arange(truth.shape[1]), known, wide),
            }
            once = create(runtime, f"once-{number}", loaded)
            enrol(once, FIRST, references, np.arange(truth.shape[1]))
            for layout, (source, second, queried, alike) in layouts.items():
                both = create(runtime, f"{layout.replace(' ', '-')}-{number}", loaded)
                enrol(both, FIRST, references, np.arange(truth.shape[1]))
                enrol(both, SECOND, source, second)
                right = {FIRST: wide, SECOND: alike}
                made = {"once": verdicts(once, loaded, queries, queried, right)}
                made["not aligned"] = verdicts(both, loaded, queries, queried, right)
                result = align(runtime, both.record.id)
                made["aligned"] = verdicts(both, loaded, queries, queried, right)
                least = LEAST * made["once"]["right"]
                for case, shares in made.items():
                    bar = verdict(round(shares["right"], 3), round(least, 3), True) if case == "aligned" else ""
                    rows.append([f"{name}, {layout}, {case}", *(f"{share:.3f}" for share in shares.values()), bar])
                (one,) = result["traverses"]
                figures["environments"][f"{name}, {layout}"] = made | {"frames": len(second), "paired": one["paired"]}
                rows.append([f"{name}, {layout}, paired", f"{one['paired']} of {len(second)}", "", "", "", ""])
        runtime.jobs.close()
        runtime.statistics.close()
        runtime.sessions.close()
        runtime.engine.close()
    columns = ["map", "right", "wrong", "ambiguous", "unknown", "bar"]
    report("aligned-maps", f"two traverses without poses, {encoder}", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
