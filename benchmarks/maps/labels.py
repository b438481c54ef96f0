"""The gain of labels of doubtful frames: the Brier score of held-out frames before and after they calibrate a map.

    python -m benchmarks.maps.labels ../shared/datasets/eval

A service has a map of the first walk, which stores frames for review.  One half of the second walk queries it, and half
as many strangers: frames of the other data set.  The stored frames are labelled through the API by the truth
of the data set, as a person would, first those that were answered ambiguous or unknown, then all; and the map is
calibrated by its own frames, by the labels, by both, or by the labels beside the encoder's calibration.  Then it is
queried with the other half of the walk, and strangers that it has not seen.  Both halves are held out in turn.

The Brier score is the mean square of the difference between a stated probability and what is true: 1 if the best match
shows the place, else 0.  A frame without a probability counts as one of 0.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import httpx
import numpy as np
import typer

from benchmarks.process import service
from benchmarks.report import report
from lab.evaluation.data.datasets import find_dataset, open_dataset

FOLDERS = {"corridor": "corridor", "lip6": "lip6_outdoor"}
STORED_VERDICTS: Mapping[str, Sequence[str]] = {
    "none": (),
    "doubtful": ("ambiguous", "unknown"),
    "all": ("recognized", "ambiguous", "unknown"),
}
"""Which answers' frames are labelled."""

UNLABELLED: Mapping[str, Mapping[str, str] | None] = {"the encoder": None, "own frames": {"method": "map"}}
LABELLED: Mapping[str, Mapping[str, str] | None] = {
    "labels": {"method": "labels", "beside": "none"},
    "labels, own frames": {"method": "labels", "beside": "map"},
    "labels, the encoder": {"method": "labels", "beside": "encoder"},
}


@dataclass(frozen=True)
class LabelledFrame:
    """A query frame, with the ids of the places that it shows; none of a stranger."""

    data: bytes
    places: tuple[str, ...]


@dataclass(frozen=True)
class LabelledWalk:
    """A data set: the frames of the map, and the query frames, in their order."""

    name: str
    references: Sequence[bytes]
    queries: Sequence[LabelledFrame]


def walk(name: str, folder: Path, most: int) -> LabelledWalk:
    """A data set from its folder, with a limited number of queries."""
    pair = open_dataset(find_dataset(name), folder / FOLDERS[name])
    queries = [
        LabelledFrame(path.read_bytes(), tuple(place_id(int(row)) for row in true))
        for path, true in zip(pair.queries, pair.truth, strict=True)
    ]
    chosen = np.unique(np.linspace(0, len(queries) - 1, min(most, len(queries))).astype(int))
    queries = [queries[index] for index in chosen]
    return LabelledWalk(name, [path.read_bytes() for path in pair.references], queries)


def place_id(row: int) -> str:
    return f"p{row:05d}"


def halves(of: LabelledWalk, other: LabelledWalk) -> tuple[list[LabelledFrame], list[LabelledFrame]]:
    """The two halves of a map's queries: of the walk, and half as many strangers, evenly taken from another."""
    middle, count = len(of.queries) // 2, len(of.queries) // 2
    chosen = np.linspace(0, len(other.queries) - 1, count).astype(int)
    strangers = [LabelledFrame(other.queries[index].data, ()) for index in chosen]
    return (
        [*of.queries[:middle], *strangers[: count // 2]],
        [*of.queries[middle:], *strangers[count // 2 :]],
    )


def ask(client: httpx.Client, map_id: str, frames: Sequence[LabelledFrame]) -> dict[str, float]:
    """The Brier score of a map's answers to frames, and the shares that are recognized and rightly so."""
    squares, recognized, right = [], 0, 0
    for frame in frames:
        answer = query(client, map_id, frame.data)
        best = answer["matches"][0]["place"]["id"] if answer["matches"] else None
        squares.append(((answer["probability"] or 0.0) - (best in frame.places)) ** 2)
        if answer["verdict"] == "recognized":
            recognized += 1
            right += best in frame.places
    known = sum(bool(frame.places) for frame in frames)
    return {
        "brier": float(np.mean(squares)),
        "recall": right / known,
        "precision": right / recognized if recognized else float("nan"),
    }


def query(client: httpx.Client, map_id: str, data: bytes) -> dict[str, Any]:
    """How a map answers a frame."""
    kind = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
    response = client.post(f"/v1/maps/{map_id}/query", content=data, headers={"Content-Type": kind})
    answer: dict[str, Any] = response.raise_for_status().json()
    return answer


def make_map(
    client: httpx.Client, map_id: str, of: LabelledWalk, verdicts: Sequence[str] = STORED_VERDICTS["all"]
) -> None:
    """A map of a walk that keeps the frames with some verdicts for review."""
    review = {"verdicts": list(verdicts), "most_frames": 10_000}
    client.post("/v1/maps", json={"id": map_id, "keep": "none", "review": review}).raise_for_status()
    for row, data in enumerate(of.references):
        kind = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
        path = f"/v1/maps/{map_id}/places/{place_id(row)}?sequence=first"
        client.put(path, content=data, headers={"Content-Type": kind}).raise_for_status()


def label_stored(client: httpx.Client, map_id: str, frames: Sequence[LabelledFrame], verdicts: Sequence[str]) -> int:
    """Label the stored frames with these verdicts by the truth; returns how many there are."""
    shown = {hashlib.sha256(frame.data).hexdigest(): frame.places for frame in frames}
    items: list[dict[str, Any]] = []
    cursor: str | None = ""
    while cursor is not None:
        given: dict[str, str | int] = {"limit": 1000} | ({"cursor": cursor} if cursor else {})
        page = client.get(f"/v1/maps/{map_id}/review", params=given).raise_for_status().json()
        items += [item for item in page["items"] if item["answer"]["verdict"] in verdicts]
        cursor = page["next_cursor"]
    for item in items:
        places = shown[item["sha256"]]
        said: dict[str, object] = {"place": places[len(places) // 2]} if places else {"stranger": True}
        client.post(f"/v1/maps/{map_id}/review/{item['id']}", json=said).raise_for_status()
    return len(items)


def measure(client: httpx.Client, of: LabelledWalk, other: LabelledWalk) -> list[dict[str, Any]]:
    """The figures of a data set by what was labelled, how the map was calibrated, and which half was held out."""
    found: list[dict[str, Any]] = []
    parts = halves(of, other)
    for turn, (queried, held_out) in enumerate((parts, parts[::-1])):
        map_id = f"{of.name}-{turn}"
        make_map(client, map_id, of)
        for frame in queried:
            query(client, map_id, frame.data)
        time.sleep(2)  # the last frames are written a moment after their answers
        client.patch(f"/v1/maps/{map_id}", json={"review": None}).raise_for_status()
        for stored, verdicts in STORED_VERDICTS.items():
            labels = label_stored(client, map_id, queried, verdicts)
            for order, body in (LABELLED if labels else UNLABELLED).items():
                client.patch(f"/v1/maps/{map_id}", json={"calibration": None}).raise_for_status()
                done = {"map": of.name, "kept": stored, "labels": labels, "half": turn, "order": order}
                if body is not None:
                    response = client.post(f"/v1/maps/{map_id}/calibrate", json=body, timeout=600)
                    if response.status_code != 200:
                        found.append({**done, "refused": response.json()["detail"]})
                        continue
                found.append({**done, "frames": len(held_out), **ask(client, map_id, held_out)})
    return found


def main(
    folder: Annotated[Path, typer.Argument(help="The folder of the data sets.")],
    only: Annotated[str | None, typer.Option(help="Only this data set.")] = None,
    most: Annotated[int, typer.Option(help="Most frames of each second walk, evenly taken.")] = 1000,
) -> None:
    """Measure, print a table and write JSON."""
    walks = {name: walk(name, folder, most) for name in FOLDERS}
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        data_dir = Path(temporary) / "data"
        with service(data_dir, settings={"REQUEST_TIMEOUT": 600}, log=Path(temporary) / "log") as process:
            for name, other in (("corridor", "lip6"), ("lip6", "corridor")):
                if only in (None, name):
                    found += measure(process.client, walks[name], walks[other])
    rows: list[list[object]] = []
    for name, stored, order in dict.fromkeys((one["map"], one["kept"], one["order"]) for one in found):
        some = [one for one in found if (one["map"], one["kept"], one["order"]) == (name, stored, order)]
        held = [one for one in some if "brier" in one]
        total = sum(one["frames"] for one in held)
        figures = {
            figure: sum(one[figure] * one["frames"] for one in held) / total if held else float("nan")
            for figure in ("brier", "recall", "precision")
        }
        brier = f"{figures['brier']:.4f}" if len(held) == len(some) else f"refused for {len(some) - len(held)}"
        labels = sum(one["labels"] for one in some)
        rows.append([name, stored, labels, order, brier, figures["recall"], figures["precision"]])
    columns = ["map", "labelled", "labels", "calibrated by", "Brier", "recall", "precision"]
    report("labels", "Held-out halves, with half as many strangers", columns, rows, {"found": found})


if __name__ == "__main__":
    typer.run(main)
