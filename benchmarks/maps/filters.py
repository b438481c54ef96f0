"""The cost of filters: queries of a large map that may find 1 % of it, against the same queries unfiltered.

    python -m benchmarks.maps.filters [--places 100000] [--rounds 15] [--keep FOLDER]

The map is written through the store, of descriptors mixed from those of sample frames, and
every place has a pose, a heading, a time, a sequence and metadata.  Measured is all that a query takes after its
encoding (what may be found, search, second stage, verdict, look-up), for every kind of filter in turn, so that all see
the same machine; given are medians, and that of the ratio to the same query unfiltered.  ``--keep`` is where the map
lies, used again when it is there already.
"""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.process import median
from benchmarks.report import report, verdict
from core.maps.selection import Selection
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question
from core.recognition.recognition import locate
from core.store import Directory, Map
from service.commands.timing.samples import fill_map, sample_descriptors, sample_frame
from service.queries.parameters import FilterParameters

MAP = "filtered"
START = datetime(2026, 1, 1, tzinfo=UTC)
SEQUENCES = 100
TRIES = 4
"""The fastest of all but the first counts: others at work on the machine make a search slower, never faster."""


def fields(index: int) -> PlaceFields:
    """Of places a metre apart along a spiral of streets, a second after one another."""
    return PlaceFields(
        pose=Pose(x=index % 1000, y=10.0 * (index // 1000), heading=(index * 7) % 360),
        timestamp=START + timedelta(seconds=index),
        sequence=f"run-{index % SEQUENCES}",
        metadata={"tile": index % 100, "half": index % 2},
    )


def selections(places: int) -> dict[str, Selection | None]:
    """The filters by name; but for the first and the last three they allow about 1 % of the places."""
    share = places // 100
    radius = (share * 10 / np.pi) ** 0.5  # one place to ten square metres
    middle = {"x": 500.0, "y": places / 200}
    kinds: dict[str, dict[str, object]] = {
        "position and radius": {**middle, "radius": radius},
        "heading": {"heading": 90, "heading_tolerance": 1.8},
        "sequence": {"sequences": "run-7"},
        "time": {"after": START, "before": START + timedelta(seconds=share)},
        "metadata": {"where": '{"tile": 42}'},
        "position, traverse, metadata": {
            **middle,
            "radius": 7 * radius,
            "where": '{"half": 1}',
            "sequences": "run-1,run-3",
        },
        "half of all, by metadata": {"where": '{"half": 1}'},
        "own last frames left out": {"sequence": "run-7", "exclude_frames": 50},
        "soft position": {**middle, "radius": radius, "soft": "position"},
    }
    found: dict[str, Selection | None] = {"nothing: all places": None}
    found |= {name: FilterParameters.model_validate(kind).selection() for name, kind in kinds.items()}
    return found


def queries(encoder: Encoder, count: int) -> list[Encoding]:
    """Encodings of mixed frames that are in no map."""
    template = encoder.encode(sample_frame(0))
    made = list(sample_descriptors(encoder, 61 + count, seed=99))[-count:]
    return [Encoding(descriptor, local, template.regions, template.milliseconds) for descriptor, local in made]


def measured(map_: Map, encoder: Encoder, rounds: int) -> dict[str, dict[str, float]]:
    """Milliseconds of a query and share of the places by kind."""
    kinds = selections(map_.count_places())
    times: dict[str, list[float]] = {name: [] for name in kinds}
    choosing: dict[str, list[float]] = {name: [] for name in kinds}
    shares: dict[str, float] = {}
    for encoding in queries(encoder, rounds):
        tries: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
        for _ in range(TRIES):
            for name, selection in kinds.items():
                began = time.perf_counter()
                scope = map_.scope(selection)
                chosen = time.perf_counter()
                locate(map_, encoder, [Query(encoding, Question(5, selection))])
                tries[name].append((1e3 * (time.perf_counter() - chosen), 1e3 * (chosen - began)))
                shares[name] = 1.0 if scope.allowed is None else float(scope.allowed.mean())
        for name, found in tries.items():
            fastest, choosing_it = min(found[1:])  # the first one reads what is not in the system's cache
            times[name].append(fastest)
            choosing[name].append(choosing_it)
    plain = times["nothing: all places"]
    return {
        name: {
            "share": shares[name],
            "choice_milliseconds": median(choosing[name]),
            "milliseconds": median(times[name]),
            "ratio": median([one / other for one, other in zip(times[name], plain, strict=True)]),
        }
        for name in kinds
    }


def main(
    places: Annotated[int, typer.Option(min=1000)] = 100_000,
    rounds: Annotated[int, typer.Option(min=1)] = 15,
    keep: Annotated[Path | None, typer.Option(help="Where the map lies, and stays.")] = None,
) -> None:
    """Measure, print a table and write JSON."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if not (folder / "maps" / MAP).is_dir():
            fill_map(folder, MAP, encoder, places, fields=fields)
        atlas = Directory(folder)
        stack.callback(atlas.close)
        map_ = atlas.get(MAP)
        tier = map_.index_status().tier
        figures = measured(map_, encoder, rounds)
        places = map_.count_places()
    rows = [
        (
            name,
            f"{100 * found['share']:.2f} %",
            found["choice_milliseconds"],
            found["milliseconds"],
            found["ratio"],
            verdict(found["ratio"], 1.0) if found["share"] < 0.015 else "",
        )
        for name, found in figures.items()
    ]
    columns = ("what is known", "allowed", "of which choice, ms", "query, ms", "ratio", "limit at 1 %")
    title = f"queries of {places} places, tier {tier}; without encoding"
    report("filters", title, columns, rows, {"places": places, "tier": tier, "rounds": rounds, "queries": figures})


if __name__ == "__main__":
    typer.run(main)
