"""A rehearsal: everything that robots and operators wait for is done once, on small maps that are thrown away.

The first time of everything in a process is slow: Numba compiles its loops or loads compiled ones, and networks,
indexes and SQLite make their working memory.  Without a rehearsal a robot waits for that at its first frame of each
kind.

``python -m service.engine.rehearsal FOLDER`` fills a folder with the loops that Numba compiles, for each kind of
processor that this machine can play (``core.kernels.compiled``), so that no start of a service from an image compiles.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from core.belief import Odometry, Run, RunOptions, Step, evidence_of, place_graph, view_of
from core.errors import StorageFailure, StorageFull
from core.frames.intrinsics import Intrinsics
from core.frames.preprocessing import Pixels
from core.judgement.alignment import LEAST_FRAMES, of_matrix, shared_stretches
from core.kernels.compiled import PROCESSOR, instructions, levels, processor, settings_of
from core.maps.forms import COMPRESSED, inner_products, pack_descriptors
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, canary_frame
from core.method.regions import box_sums
from core.places import PlaceFields, Pose
from core.recognition import Answer, enrol, recognize
from core.recognition.question import Question
from core.recognition.stages import neighborhood_of
from core.store import Directory, Map

FRAMES = 2
"""Of each of the two traverses."""

CAMERA = "front"
"""Its intrinsics are known, so that turns, shifts and the points of several places are computed."""

STEPS = (Step(), Step(reach=2.0), Step(odometry=Odometry(2.0)))
"""The knowledge of a motion that sessions may have: none, a speed limit, odometry."""

log = logging.getLogger("placerec.rehearsal")


def rehearse(encoder: Encoder) -> None:
    """Enrol, recognize, follow a run and align two traverses, as requests do.

    Requests do without: if anything fails, such as a temporary folder that cannot be written, the log says so and no
    more is done.
    """
    said = "the first request of each kind takes longer, for nothing could be rehearsed"
    try:
        _rehearse(encoder)
    except (StorageFull, StorageFailure, OSError) as error:
        log.warning("%s: %s", said, error)
    except Exception:
        log.exception(said)


def _rehearse(encoder: Encoder) -> None:
    with tempfile.TemporaryDirectory(prefix="placerec-rehearsal-") as folder:
        maps = Directory(Path(folder))
        try:
            shape = encoder.local_shape
            _rehearse_in(maps.create("rehearsal", encoder.identity, encoder.dimension, local_shape=shape), encoder)
        finally:
            maps.close()
    shared_stretches(of_matrix(np.eye(LEAST_FRAMES, dtype=np.float32)), LEAST_FRAMES, LEAST_FRAMES)
    # Loops that only compressed maps and encoders without a projection use.
    descriptors = np.ones((1, encoder.dimension), np.float32)
    inner_products(descriptors, pack_descriptors(descriptors, COMPRESSED), COMPRESSED)
    box_sums(np.ones((1, 1, 8), np.float32), np.array([[0, 0, 1, 1]], np.int32))


def _rehearse_in(map_: Map, encoder: Encoder) -> None:
    frames, moment = list(_frames()), datetime(2026, 1, 1, tzinfo=UTC)
    height, width = frames[0].shape[:2]
    map_.cameras.put(CAMERA, None, Intrinsics(width=width, height=height, fx=500, fy=500, cx=width / 2, cy=height / 2))
    for number, frame in enumerate(frames):
        traverse, place = divmod(number, FRAMES)
        pose = Pose(x=2.0 * place, y=0.5 * traverse, heading=0.0)
        taken = moment + timedelta(seconds=number)
        fields = PlaceFields(pose=pose, timestamp=taken, sequence=f"traverse-{traverse}", camera=CAMERA)
        enrol(map_, f"place-{number}", _file(frame), encoder, fields)
    seen = frames[:FRAMES]
    question = Question(verify="always", camera=CAMERA)
    _follow(map_, seen, [recognize(map_, _file(frame), encoder, question) for frame in seen])


def _follow(map_: Map, frames: Sequence[Pixels], answers: Sequence[Answer]) -> None:
    """A run over the answers with each kind of motion."""
    snapshot, neighborhood = map_.snapshot(), neighborhood_of(map_)
    graph = place_graph(snapshot.whereabouts, np.flatnonzero(snapshot.alive), snapshot.rows, neighborhood)
    for step in STEPS:
        run = Run(RunOptions(lag=1), graph)
        for frame, answer in zip(frames, answers, strict=True):
            run.advance(evidence_of(answer, neighborhood), step, view_of(frame))
            run.estimate(1, snapshot.alive)
            run.earlier(1, snapshot.alive)


def _frames() -> Iterator[Pixels]:
    """The canary frame seen from a little further aside each time, for each of two traverses."""
    whole = canary_frame()
    for number in range(2 * FRAMES):
        yield np.ascontiguousarray(np.roll(whole, 24 * number, axis=1))


def _file(frame: Pixels) -> bytes:
    return cv2.imencode(".jpg", frame)[1].tobytes()


def main() -> None:
    """Check the packaged default encoder on this machine, and rehearse with it; here a failure ends the build."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    encoder.check_golden()
    _rehearse(encoder)


def ship(folder: Path) -> None:
    """Do the same once for this processor and once for each level that it has, each in a process of its own.

    Raises:
        subprocess.CalledProcessError: one failed.
    """
    for settings in ({}, *map(settings_of, levels(instructions()))):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder), **settings}
        subprocess.run([sys.executable, "-m", "service.engine.rehearsal"], env=environment, check=True)
    (folder / PROCESSOR).write_text(processor())


if __name__ == "__main__":
    ship(Path(sys.argv[1])) if len(sys.argv) > 1 else main()
