"""How long the stages of recognition take: medians of interleaved runs, so that what disturbs one disturbs all."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from core.frames.images import decode
from core.frames.preprocessing import Pixels, prepare
from core.method.encoder import Encoder, Encoding
from core.networks.forward import forward_pass
from core.networks.network import ShallowNetwork
from core.networks.torch_network import TorchNetwork, as_tensor, follow_threads
from core.recognition.question import Query, Question
from core.recognition.recognition import locate
from core.store import Directory
from core.threads import allowed_threads, each
from service.commands.timing.samples import fill_map, sample_frame

LAYOUTS = {"contiguous": torch.contiguous_format, "channels last": torch.channels_last}
OWN = "its own"
"""The pass of a network that is no torch module."""

MATCHES = 5
"""Matches that a timed query lists."""


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


def forward_passes(encoder: Encoder, pixels: Pixels) -> dict[str, Callable[[], object]]:
    """The bare forward pass: the encoder's module, eager float32, batch of one, in two memory layouts.

    The module and its input are copied into the layout beforehand: only the pass is measured.  A network of
    another kind has one pass, its own.
    """
    backbone = encoder.extractor.backbone
    image = prepare(pixels, backbone.input)[None]
    if not isinstance(backbone, ShallowNetwork):
        own = forward_pass(backbone)
        return {OWN: lambda: own(image)}

    def make(layout: torch.memory_format) -> Callable[[], object]:
        module = TorchNetwork.of(backbone).to(memory_format=layout)  # type: ignore[call-overload]
        shown = as_tensor(image).contiguous(memory_format=layout)

        def run() -> object:
            follow_threads()
            with torch.inference_mode():
                return module(shown)

        return run

    return {name: make(layout) for name, layout in LAYOUTS.items()}


def better_forward(times: Mapping[str, float]) -> float:
    """The bare forward pass in the better of its layouts, milliseconds."""
    return min(times[name] for name in (*LAYOUTS, OWN) if name in times)


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
    """Decode and encode frames as fast as this process can: each core decodes some, then encodes some."""
    return encoder.encode_batch(each(decode, frames, allowed_threads()))


@contextmanager
def search_run(encoder: Encoder, places: int) -> Iterator[Callable[[], object]]:
    """A run that answers an encoded query as the service does: both stages, verdict, look-up of the matches.

    The map has ``places`` sample places and lies in a temporary folder until the block ends.
    """
    query = Query(encoder.encode(sample_frame(0)), Question(MATCHES))
    with tempfile.TemporaryDirectory() as folder:
        fill_map(Path(folder), "sample", encoder, places)
        maps = Directory(Path(folder))
        try:
            map_ = maps.get("sample")
            yield lambda: locate(map_, encoder, [query])
        finally:
            maps.close()
