"""How long things take: medians of interleaved runs, so that what disturbs one disturbs all."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from core.frames.images import decode
from core.frames.preprocessing import Pixels, prepare
from core.method.encoder import Encoder, Encoding
from core.places import NO_POSE, Neighborhood
from core.recognition.stages import examine
from core.storage.files.segment_files import ROWS_PER_SEGMENT
from core.storage.search.segment import Location
from core.storage.search.snapshot import Snapshot
from core.threads import each

LAYOUTS = {"contiguous": torch.contiguous_format, "channels last": torch.channels_last}


def medians(runs: Mapping[str, Callable[[], object]], rounds: int, warm_up: int = 3) -> dict[str, float]:
    """The median time of each run in milliseconds; every round runs all of them once, in turn."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for index in range(warm_up + rounds):
        for name, run in runs.items():
            began = time.perf_counter()
            run()
            if index >= warm_up:
                times[name].append(1e3 * (time.perf_counter() - began))
    return {name: float(np.median(spent)) for name, spent in times.items()}


def sample_picture(seed: int = 0, width: int = 640, height: int = 480) -> Pixels:
    """Blocks, circles and grain: as rich in regions, and as large as a file, as a photograph."""
    random = np.random.default_rng(seed)
    picture = np.zeros((height, width, 3), np.uint8)
    picture[:] = np.linspace(60, 200, height, dtype=np.uint8)[:, None, None]
    for _ in range(60):
        x, y = int(random.integers(width)), int(random.integers(height))
        colour = tuple(int(value) for value in random.integers(0, 256, 3))
        if random.random() < 0.6:
            corner = (x + int(random.integers(10, 160)), y + int(random.integers(10, 160)))
            cv2.rectangle(picture, (x, y), corner, colour, -1)
        else:
            cv2.circle(picture, (x, y), int(random.integers(5, 70)), colour, -1)
    grain = random.normal(0, 9, (height, width, 1))
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 1.2) + grain, 0, 255).astype(np.uint8)


def jpeg(picture: Pixels, quality: int = 90) -> bytes:
    """The picture as JPEG bytes."""
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def forward_passes(encoder: Encoder, pixels: Pixels) -> dict[str, Callable[[], object]]:
    """The bare forward pass: the encoder's module, eager float32, batch of one, in two memory layouts.

    The module and its input are copied into the layout beforehand: what is measured is the pass.

    Raises:
        TypeError: the encoder's backbone is no torch module.
    """
    backbone = encoder.extractor.backbone
    if not isinstance(backbone, nn.Module):
        raise TypeError(f"{encoder.name} runs on no torch module of its own.")
    image = torch.from_numpy(prepare(pixels, backbone.input)[None]).permute(0, 3, 1, 2)

    def make(layout: torch.memory_format) -> Callable[[], object]:
        module = copy.deepcopy(backbone).float().to(memory_format=layout)  # type: ignore[call-overload]
        shown = image.contiguous(memory_format=layout)

        def run() -> object:
            with torch.inference_mode():
                return module(shown)

        return run

    return {name: make(layout) for name, layout in LAYOUTS.items()}


def encoding_runs(encoder: Encoder, data: bytes) -> dict[str, Callable[[], object]]:
    """Runs to compare: the two bare forward passes, ``encode`` (with decoding), ``decode``, ``regions``."""
    pixels = decode(data)
    activations = encoder.extractor.activations([pixels])[0]
    return {
        **forward_passes(encoder, pixels),
        "encode": lambda: encoder.encode(decode(data)),
        "decode": lambda: decode(data),
        "regions": lambda: encoder.extractor.regions(activations),
    }


def encode_batch(encoder: Encoder, frames: Sequence[bytes]) -> list[Encoding]:
    """Decode and encode frames as fast as this process can: the cores decode some each, and encode some each."""
    return encoder.encode_batch(each(decode, frames, torch.get_num_threads()))


def search_run(encoder: Encoder, places: int) -> Callable[[], object]:
    """A search of both stages among so many places of random values, one of which is asked for."""
    random, middle = np.random.default_rng(0), places // 2
    known = random.standard_normal((places, encoder.dimension), np.float32)
    local = random.integers(-127, 128, (places, *encoder.local_shape), np.int8)
    empty = Snapshot(encoder.dimension, ROWS_PER_SEGMENT, local_shape=encoder.local_shape, halves=True)
    snapshot = empty.appended(list(known), [Location(NO_POSE, (0.0, 0.0, 0.0), -1, 0)] * places, list(local))

    def run() -> object:
        rows, products = snapshot.search(known[middle])

        def gains(positions: NDArray[np.int64]) -> NDArray[np.float32]:
            return encoder.agreement(local[middle], snapshot.locals_in_place(rows[positions]))

        scores, places_ = encoder.scores_from_inner_products(products), snapshot.whereabouts_at(rows)
        return examine(scores, places_, Neighborhood(0.0, 0), encoder.candidates, gains)

    return run


def better_forward(times: Mapping[str, float]) -> float:
    """The bare forward pass in the better of the two layouts, milliseconds."""
    return min(times[name] for name in LAYOUTS)
