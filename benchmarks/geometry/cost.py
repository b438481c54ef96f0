"""The cost of geometric verification: keypoints of a frame, ten candidates of a query, keypoints of an enrolment.

    python -m benchmarks.geometry.cost [--images FOLDER]

The images are neighbours of one traverse, so that many of their keypoints match; without them, sample frames and their
second looks are taken.  Each is resized to 640 x 480.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from benchmarks.geometry.same_view import inliers_by_opencv
from benchmarks.report import report, verdict
from core.frames.images import decode
from core.frames.preprocessing import Pixels, second_look
from core.frames.traverses import SUPPORTED_SUFFIXES
from core.geometry.detection import find_keypoints, shown_size
from core.geometry.keypoints import MOST, record_bytes
from core.geometry.matching import neighbors_among
from core.geometry.verification import fitting, points_of, verify
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.networks.xfeat import load_xfeat
from core.threads import allowed_threads, cores, each, share_cores
from service.commands.timing.samples import sample_frame

CANDIDATES = 10
MILLISECONDS = 60
"""At most, for the keypoints of a query and its candidates."""
FRAMES = 25
"""A second at least, encoded and with keypoints."""
SIZE = (640, 480)


def pictures(folder: Path | None) -> list[Pixels]:
    """A query and its candidates, uint8 [480, 640, 3] each."""
    if folder is None:
        looks = [sample_frame(seed) for seed in range(CANDIDATES // 2 + 1)]
        return [frame for look in looks for frame in (look, second_look(look))][: CANDIDATES + 1]
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUPPORTED_SUFFIXES)
    middle = paths[len(paths) // 2 :][: CANDIDATES + 1]
    return [np.asarray(cv2.resize(decode(path.read_bytes()), SIZE), np.uint8) for path in middle]


def measured(runs: dict[str, Callable[[], object]], rounds: int) -> dict[str, tuple[float, float, float]]:
    """Of interleaved runs, in milliseconds: the median, the least, and the median of all threads' processor time."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for index in range(3 + rounds):
        for name, run in runs.items():
            began, busy = time.perf_counter(), time.process_time()
            run()
            if index >= 3:
                spent[name].append((1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - busy)))
    made = {name: np.array(values) for name, values in spent.items()}
    return {
        name: (float(np.median(one[:, 0])), float(one[:, 0].min()), float(np.median(one[:, 1])))
        for name, one in made.items()
    }


def main(
    images: Annotated[Path | None, typer.Option(help="A folder of frames in the order of a traverse.")] = None,
    rounds: Annotated[int, typer.Option(min=3)] = 40,
    threads: Annotated[int, typer.Option(min=0, help="0: every core.")] = 0,
) -> None:
    """Interleaved runs; on a busy machine the least time and the processor's say more than the median."""
    share_cores(threads or cores())
    network, encoder, frames = load_xfeat(), EncoderCatalogue().get(DEFAULT_ENCODER), pictures(images)
    query, *candidates = [find_keypoints(network, frame) for frame in frames]
    shown = np.asarray(cv2.resize(frames[0], shown_size(*SIZE)), np.uint8)
    (there,) = neighbors_among(query, candidates[:1])
    matches = np.flatnonzero(there >= 0)
    points = points_of(query)[matches], points_of(candidates[0])[there[matches]]
    used = allowed_threads()

    times = measured(
        {
            "forward pass of XFeat": lambda: network(shown),
            "keypoints of a frame": lambda: find_keypoints(network, frames[0]),
            "matches of one candidate": lambda: neighbors_among(query, candidates[:1]),
            "fundamental matrix of one candidate": lambda: fitting(*points),
            "the same by MAGSAC++ of OpenCV": lambda: inliers_by_opencv(*points),
            f"verification of {len(candidates)} candidates": lambda: verify(query, candidates),
            "all in": lambda: verify(find_keypoints(network, frames[0]), candidates),
            "encoding of the frames": lambda: encoder.encode_batch(frames),
            "encoding of the frames, and keypoints": lambda: (
                encoder.encode_batch(frames),
                each(lambda frame: find_keypoints(network, frame), frames, used),
            ),
        },
        rounds,
    )
    enrolled = [1e3 * len(frames) / spent for spent in times["encoding of the frames, and keypoints"]]
    bars = {"all in": verdict(times["all in"][0], MILLISECONDS)}
    rows: list[tuple[object, ...]] = [(name, *spent, bars.get(name, "")) for name, spent in times.items()]
    rows.append(("frames a second, with keypoints", *enrolled, verdict(enrolled[0], FRAMES, at_least=True)))
    kilobytes = record_bytes(MOST) / 1000
    rows.append(("KB a place", kilobytes, "", "", verdict(kilobytes, 40)))
    title = f"{used} threads; {len(matches)} matches with the first candidate"
    figures = {"milliseconds": times, "frames_a_second": enrolled, "matches": len(matches)}
    report("geometry_cost", title, ["", "median ms", "least", "of the processor", ""], rows, figures)


if __name__ == "__main__":
    typer.run(main)
