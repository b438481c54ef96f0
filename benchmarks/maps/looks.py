"""The gain of looks: frames of other conditions, asked in maps whose places have 1, 2, 4 or 11 looks.

    python -m benchmarks.maps.looks --datasets ../shared/datasets

Every webcam is a place.  Its first frame by day is its first look; of its other frames every second one may become a
look, by night and by day in turn, and the rest are the queries.  Each query is asked twice: with its place in the map,
and without it, as a stranger.  The webcams of ``train/day_night`` (13 places with enough frames) and of
``eval/webcams`` (5 places) have maps of their own.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from benchmarks.report import report, verdict
from core.frames.images import decode
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.maps import Enrolment, Selection
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields, look_address
from core.recognition.question import Query, Question
from core.recognition.recognition import locate
from core.store import Directory, Map

LOOKS = (0, 1, 3, 10)
"""How many looks a place has besides its first."""

BAR = 0.03
"""At most this share of the strangers may be recognized; ``benchmarks.learning.strangers`` has other sets."""

LEAST_FRAMES = 14
"""A webcam with fewer is left out."""


@dataclass(frozen=True)
class Frame:
    """One picture of a webcam, encoded.

    name: SHA-256 of its file.
    """

    name: bytes
    encoding: Encoding
    keypoints: Keypoints


@dataclass(frozen=True)
class Webcam:
    """A place: its first look, the frames that may become looks, in this order, and the frames to ask with."""

    name: str
    first: Frame
    looks: Sequence[Frame]
    queries: Sequence[Frame]


def frame_of(encoder: Encoder, path: Path) -> Frame:
    """A picture that is read and encoded."""
    data = path.read_bytes()
    pixels = decode(data)
    return Frame(hashlib.sha256(data).digest(), encoder.encode(pixels), find_keypoints(packaged_xfeat(), pixels))


def webcams(encoder: Encoder, folder: Path) -> Iterator[Webcam]:
    """The webcams of a data set, each a folder; names of frames by day or by night begin with it, where they say so."""
    for webcam in sorted(path for path in folder.iterdir() if path.is_dir()):
        every = sorted(path for path in webcam.iterdir() if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
        night = [path for path in every if path.name.startswith("night")]
        day = [path for path in every if path not in night]
        if len(every) < LEAST_FRAMES or not day:
            continue
        first, *day = day
        turns = chain.from_iterable(zip_longest(night[1::2], day[1::2]))
        looks = [path for path in turns if path is not None]
        encoded = {path: frame_of(encoder, path) for path in (first, *looks, *night[::2], *day[::2])}
        yield Webcam(
            webcam.name,
            encoded[first],
            [encoded[path] for path in looks],
            [encoded[path] for path in (*night[::2], *day[::2])],
        )


def enrolment(place: str, frame: Frame) -> Enrolment:
    """A frame as a place, or as the look with an address."""
    encoding = frame.encoding
    return Enrolment(
        place,
        PlaceFields(),
        encoding.descriptor,
        len(encoding.regions),
        frame.name,
        encoding.local,
        keypoints=frame.keypoints,
    )


def asked(map_: Map, encoder: Encoder, frame: Frame, without: str | None = None) -> tuple[str | None, str, float]:
    """The best match of a frame, the verdict and the milliseconds; without a place, if one is named."""
    question = Question(k=1, selection=None if without is None else Selection(excluded=without))
    began = time.perf_counter()
    (answer,) = locate(map_, encoder, [Query(frame.encoding, question, lambda: frame.keypoints)])
    milliseconds = 1e3 * (time.perf_counter() - began)
    return answer.matches[0][1].id if answer.matches else None, answer.judgement.verdict, milliseconds


def measured(encoder: Encoder, places: Sequence[Webcam], looks: int) -> dict[str, float]:
    """The shares of the answers in a map whose places have so many looks besides their first."""
    with TemporaryDirectory() as folder:
        atlas = Directory(Path(folder) / "data")
        map_ = atlas.create("webcams", encoder.identity, encoder.dimension, local_shape=encoder.local_shape)
        map_.enrol([enrolment(place.name, place.first) for place in places])
        added = [
            enrolment(look_address(place.name, look.name.hex()[:16]), look)
            for place in places
            for look in place.looks[:looks]
        ]
        if added:
            map_.enrol(added)
        first = right = wrong = strangers = 0
        times = []
        for place in places:
            for frame in place.queries:
                best, verdict, milliseconds = asked(map_, encoder, frame)
                times.append(milliseconds)
                first += best == place.name
                right += verdict == "recognized" and best == place.name
                wrong += verdict == "recognized" and best != place.name
                strangers += asked(map_, encoder, frame, place.name)[1] == "recognized"
        atlas.close()
    queries = len(times)
    return {
        "looks": looks,
        "rows": len(places) + len(added),
        "queries": queries,
        "recall@1": first / queries,
        "recognized and right": right / queries,
        "recognized and wrong": wrong / queries,
        "strangers recognized": strangers / queries,
        "milliseconds": median(times),
    }


def shown(figures: dict[str, float]) -> list[str]:
    """The cells of a row: counts, shares with three decimals, and milliseconds."""
    *counts_and_shares, milliseconds = figures.values()
    return [str(one) if isinstance(one, int) else f"{one:.3f}" for one in counts_and_shares] + [f"{milliseconds:.1f}"]


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    encoder: Annotated[str, typer.Option(help="Name of an encoder.")] = "m-region-vlad",
) -> None:
    """Print the table and write the JSON."""
    loaded, rows = EncoderCatalogue().get(encoder), []
    figures = {}
    for name in ("train/day_night", "eval/webcams"):
        places = list(webcams(loaded, datasets / name))
        found = [measured(loaded, places, looks) for looks in LOOKS]
        figures[name] = found
        rows += [[name, len(places), *shown(one), verdict(one["strangers recognized"], BAR)] for one in found]
    columns = ["webcams", "places", "looks", "rows", "queries", "recall@1", "right", "wrong", "strangers", "ms", "bar"]
    report("looks", "Places with several looks", columns, rows, {"encoder": loaded.identity, "bar": BAR, **figures})


if __name__ == "__main__":
    typer.run(main)
