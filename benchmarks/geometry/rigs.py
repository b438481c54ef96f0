"""Two cameras of a rig: what verification makes of their joint answer.

    python -m benchmarks.geometry.rigs --data ../shared/datasets [--every 1]

The left and the right part of each frame, which share a fifth of its width, are two cameras.  The references are
enrolled by both, and each query is asked by both together, without verification, with ``auto`` and with ``always``.
Answers are right within the ground truth.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report
from core.frames.images import decode
from core.frames.traverses import find_images, read_ground_truth
from core.geometry.detection import find_keypoints
from core.judgement.curves import auc_pr
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question, Verify
from core.recognition.recognition import Answer, describe
from core.recognition.rigs import locate_rig
from core.store import Directory, Map

WAYS: tuple[Verify, ...] = ("never", "auto", "always")
TRAVERSES = {"corridor": ("corridor", "query", "ref"), "lip6": ("lip6_outdoor", "query", "reference")}
RADIUS = 2.0
"""Metres, one between two frames, within which places are the same."""

WIDTH = 0.6
"""The share of the frame's width that each camera sees."""


class Rig:
    """The cameras' views of pictures, each encoded, and its keypoints found, once."""

    def __init__(self, encoder: Encoder, paths: Iterable[Path]) -> None:
        pictures = [decode(path.read_bytes()) for path in paths]
        widths = [round(WIDTH * one.shape[1]) for one in pictures]
        self.views = [
            (np.ascontiguousarray(one[:, :width]), np.ascontiguousarray(one[:, -width:]))
            for one, width in zip(pictures, widths, strict=True)
        ]
        self.encodings = [[encoder.encode(view) for view in both] for both in self.views]
        self.keypoints = [[find_keypoints(packaged_xfeat(), view) for view in both] for both in self.views]

    def __len__(self) -> int:
        return len(self.views)

    def enrol(self, map_: Map, numbers: Iterable[int]) -> None:
        """Enrol both views of some frames, a metre apart."""
        for number in numbers:
            for side, pixels, encoding, keypoints in zip(
                "lr", self.views[number], self.encodings[number], self.keypoints[number], strict=True
            ):
                fields = PlaceFields(pose=Pose(x=number, y=0), sequence=side)
                digest = f"{number}{side}".encode().ljust(32)
                name = f"{number}-{side}"
                map_.enrol([describe(map_, name, fields, None, digest, pixels, encoding, keypoints=keypoints)])

    def queries(self, number: int, verify: Verify) -> list[Query]:
        """The question about both views of a frame."""
        return [
            Query(encoding, Question(5, verify=verify), partial(_given, keypoints))
            for encoding, keypoints in zip(self.encodings[number], self.keypoints[number], strict=True)
        ]


def _given(keypoints: Any) -> Any:
    return keypoints


def figures_of(answers: list[Answer], truth: NDArray[np.bool_]) -> dict[str, float]:
    """How often the answers are right and believed; truth: bool [Q, R], of queries and enrolled frames."""
    known = truth.any(1)
    first = [int(answer.matches[0][1].id.partition("-")[0]) for answer in answers]
    right = truth[np.arange(len(answers)), first]
    believed = np.array([answer.judgement.verdict == "recognized" for answer in answers])
    certain = [answer.judgement.probability or 0.0 for answer in answers]
    return {
        "recall": float(right[known].mean()),
        "auc": auc_pr(certain, right),
        "recognized": float((believed & right).sum() / known.sum()),
        "wrong": float((believed & ~right).sum() / len(answers)),
        "verified": float(np.mean([answer.third_stage.state == "verified" for answer in answers])),
    }


def main(
    data: Annotated[Path, typer.Option(help="The folder of data sets, with eval/ in it.")],
    every: Annotated[int, typer.Option(min=1, help="Take each so-manieth query.")] = 1,
) -> None:
    """Ask, and print the shares."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    for name, (dataset, queries, references) in TRAVERSES.items():
        base = data / "eval" / dataset
        asked, enrolled = find_images(base / queries), find_images(base / references)
        truth = np.zeros((len(asked), len(enrolled)), np.bool_)
        for at, shown in enumerate(read_ground_truth(base / "ground_truth.csv", *truth.shape)):
            truth[at, [*shown]] = True
        asking, there = Rig(encoder, asked[::every]), Rig(encoder, enrolled)
        half = len(there) // 2
        with tempfile.TemporaryDirectory() as folder, closing(Directory(Path(folder))) as atlas:
            for part, numbers in {"all": range(len(there)), "first half": range(half)}.items():
                settings = MapSettings(keep="none", same_place_radius=RADIUS)
                map_id = part.replace(" ", "-")
                map_ = atlas.create(map_id, encoder.identity, encoder.dimension, settings, encoder.local_shape)
                there.enrol(map_, numbers)
                known = truth[::every] & np.isin(np.arange(len(there)), numbers)
                for way in WAYS:
                    began = time.perf_counter()
                    answers = [locate_rig(map_, encoder, asking.queries(at, way)) for at in range(len(asking))]
                    spent = 1e3 * (time.perf_counter() - began) / len(answers)
                    found = figures_of(answers, known) | {"milliseconds": spent}
                    figures[f"{name}, {part}, {way}"] = found
                    rows.append((f"{name}, {part}, {way}", *found.values()))
                    print(rows[-1], flush=True)
    columns = ["", "recall@1", "AUC-PR", "recognized", "wrong", "verified", "ms"]
    report("geometry_rigs", "Two cameras, asked together", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
