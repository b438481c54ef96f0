"""Frames that show less than the places of a map: right and wrong answers, with the search for a framing and without.

Run ``python -m benchmarks.geometry.framings --datasets ../shared/datasets [--every 2] [--no-before]``."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
import typer

from benchmarks.day.pictures import Look, cut, file, portrait
from benchmarks.day.walks import WalkPair, corridor, lip6, pixels
from benchmarks.report import report
from core.frames.intrinsics import Intrinsics
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import PlaceFields, Pose
from core.recognition.framings import FrameReframing
from core.recognition.question import Question, Verify
from core.recognition.recognition import enrol, recognize
from core.store import Directory, Map

CUT, RANDOM = cut(0.6, 0.6), np.random.default_rng(0)
KINDS: dict[str, tuple[Look | None, str | None]] = {
    "plain": (None, None), "cut to 60 %": (CUT, None), "cut to 75 %": (cut(0.75, 0.75), None),
    "portrait": (portrait, None), "strangers": (None, None), "cut to 60 %, with intrinsics": (CUT, "cut"),
}  # fmt: skip
WAYS = {"": FrameReframing, ", as it is": lambda *_: None}


def make_map(atlas: Directory, encoder: Encoder, walk: WalkPair) -> Map:
    """A map of the references, which knows the camera of whole frames and that of frames that are cut to 60 %."""
    settings, whole = MapSettings(keep="none"), pixels(walk.references[0])
    made = atlas.create(walk.name, encoder.identity, encoder.dimension, settings, encoder.local_shape)
    for name, (height, width) in {"whole": whole.shape[:2], "cut": CUT(whole, RANDOM, 0).shape[:2]}.items():
        lens = {"fx": 0.75 * whole.shape[1], "fy": 0.75 * whole.shape[1], "cx": (width - 1) / 2, "cy": (height - 1) / 2}
        made.cameras.put(name, None, Intrinsics(width=width, height=height, **lens))
    for number, data in enumerate(walk.references):
        x, y, heading = walk.pose(number * walk.spacing)
        pose = Pose(x=x, y=y, heading=float(np.degrees(heading)) % 360)
        enrol(made, f"{number}", data, encoder, PlaceFields(pose=pose, sequence="walk", camera="whole"))
    return made


def row_of(answers: list[tuple[str, bool, float, float]]) -> dict[str, Any]:
    """The figures of answers, each a verdict, whether it is right, its probability and milliseconds."""
    wrong = [p for verdict, right, p, _ in answers if verdict == "recognized" and not right]
    known, doubtful = (sum(one[0] == verdict for one in answers) for verdict in ("recognized", "ambiguous"))
    counts = {"right": known - len(wrong), "wrong": len(wrong), "ambiguous": doubtful}
    sure = {"p of wrong": float(np.median(wrong)) if wrong else "", "at most": max(wrong, default="")}
    shares = {name: count / len(answers) for name, count in counts.items()}
    return {"n": len(answers), **shares, **sure, "ms": float(np.median([one[3] for one in answers]))}


def main(datasets: Annotated[Path, typer.Option()], every: int = 1, verify: Verify = "auto", before: bool = True,
         ) -> None:  # fmt: skip
    """Ask each so-manieth frame both ways in turn, and print shares of them and the processor's milliseconds."""
    encoder, answers = EncoderCatalogue().get(DEFAULT_ENCODER), defaultdict[str, Any](list)
    for walk in (corridor(datasets), lip6(datasets)):
        with tempfile.TemporaryDirectory() as folder, closing(Directory(Path(folder))) as atlas:
            map_ = make_map(atlas, encoder, walk)
            for kind, (look, camera) in KINDS.items():
                question, known = Question(verify=verify, camera=camera), kind != "strangers"
                for at, data in list(enumerate(walk.frames if known else walk.strangers))[::every]:
                    shown = data if look is None else file(look(pixels(data), RANDOM, at))
                    for way in WAYS if before else [""]:
                        began = time.process_time()
                        with patch("core.recognition.recognition.FrameReframing", WAYS[way]):
                            answer = recognize(map_, shown, encoder, question)
                        right = known and int(answer.matches[0][1].id) in walk.right(at)
                        found = right, answer.probability or 0.0, 1e3 * (time.process_time() - began)
                        answers[f"{walk.name}, {kind}{way}"].append((answer.judgement.verdict, *found))
    figures = {name: row_of(some) for name, some in answers.items()}
    rows, columns = [(name, *found.values()) for name, found in figures.items()], next(iter(figures.values()))
    report("geometry_framings", "Frames that show less than the map", ["", *columns], rows, figures)


if __name__ == "__main__":
    typer.run(main)
