"""Frames, descriptors and maps to time with: as much work as real ones, made on the spot."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from core.maps import Enrolment, MapSettings, Precision
from core.method.encoder import Encoder
from core.places import PlaceFields
from core.store import Directory

BATCH = 64
"""Places that are written together."""


def sample_frame(seed: int = 0, width: int = 640, height: int = 480) -> Pixels:
    """Blocks, circles and grain: as rich in regions, and as large as a file, as a photograph; uint8 [H, W, 3] BGR."""
    random = np.random.default_rng(seed)
    frame = np.zeros((height, width, 3), np.uint8)
    frame[:] = np.linspace(60, 200, height, dtype=np.uint8)[:, None, None]
    for _ in range(60):
        x, y = int(random.integers(width)), int(random.integers(height))
        colour = tuple(int(value) for value in random.integers(0, 256, 3))
        if random.random() < 0.6:
            corner = (x + int(random.integers(10, 160)), y + int(random.integers(10, 160)))
            cv2.rectangle(frame, (x, y), corner, colour, -1)
        else:
            cv2.circle(frame, (x, y), int(random.integers(5, 70)), colour, -1)
    grain = random.normal(0, 9, (height, width, 1))
    return np.clip(cv2.GaussianBlur(frame, (0, 0), 1.2) + grain, 0, 255).astype(np.uint8)


def jpeg(frame: Pixels, quality: int = 90) -> bytes:
    """The frame as JPEG bytes."""
    return cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def sample_descriptors(
    encoder: Encoder, count: int, frames: int = 60, seed: int = 0
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.int8]]]:
    """``count`` descriptors, float32 [D], with the statistics of real ones, and local descriptors, int8 [C, L].

    The first are those of sample frames 0, 1, …, at most ``frames`` of them.  Each further one takes the parts of
    its words, and its cells, from two of those at random.
    """
    encodings = [encoder.encode(sample_frame(index)) for index in range(min(frames, count))]
    real = [(encoding.descriptor, encoding.local) for encoding in encodings]
    yield from real
    words = 1 if encoder.whitening is not None else encoder.definition.words
    random = np.random.default_rng(seed)
    for _ in range(count - len(real)):
        a, b = random.choice(len(real), 2, replace=False)
        from_a = random.random(words) < 0.5
        descriptor = np.where(from_a[:, None], real[a][0].reshape(words, -1), real[b][0].reshape(words, -1))
        cells_from_a = random.random(encoder.local_shape[0]) < 0.5
        yield descriptor.reshape(-1), np.where(cells_from_a[:, None], real[a][1], real[b][1])


def one_sequence(_index: int) -> PlaceFields:
    """The fields of a place without pose or metadata; all places are of one traverse."""
    return PlaceFields(sequence="benchmark")


def fill_map(
    data_dir: Path,
    map_id: str,
    encoder: Encoder,
    places: int,
    precision: Precision = "half",
    fields: Callable[[int], PlaceFields] = one_sequence,
) -> None:
    """Write a map of sample descriptors; ``fields`` gives the fields of each place.

    Place i of the first 60 shows the sample frame i.

    Raises:
        StorageFailure: the directory cannot be written.
    """
    write_map(data_dir, map_id, encoder, sample_descriptors(encoder, places), precision, fields)


def write_map(
    data_dir: Path,
    map_id: str,
    encoder: Encoder,
    described: Iterable[tuple[NDArray[np.float32], NDArray[np.int8]]],
    precision: Precision = "half",
    fields: Callable[[int], PlaceFields] = one_sequence,
) -> None:
    """Write a map through the storage, its places called p00000, p00001, … in their order.

    Args:
        described: of each place its descriptor, float32 [D], and local descriptors, int8 [C, L].
        fields: gives the fields of each place.

    Raises:
        StorageFailure: the directory cannot be written.
    """
    maps = Directory(data_dir)
    settings = MapSettings(keep="none")
    made = maps.create(map_id, encoder.identity, encoder.dimension, settings, encoder.local_shape, precision=precision)
    batch: list[Enrolment] = []
    for index, (descriptor, local) in enumerate(described):
        batch.append(_enrolment(index, descriptor, local, fields(index)))
        if len(batch) == BATCH:
            made.enrol(batch)
            batch = []
    if batch:
        made.enrol(batch)
    maps.close()


def _enrolment(index: int, descriptor: NDArray[np.float32], local: NDArray[np.int8], fields: PlaceFields) -> Enrolment:
    return Enrolment(
        id=f"p{index:05d}",
        fields=fields,
        descriptor=descriptor,
        local=local,
        regions=600,
        digest=hashlib.sha256(str(index).encode()).digest(),
        thumbnail=None,
        image=None,
    )
