"""A service process to measure, and maps to measure it with."""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
from numpy.typing import NDArray

from core.evaluation.timing import sample_picture
from core.method.encoder import Encoder
from core.places import PlaceFields
from core.storage import Atlas, Enrolment, MapSettings, NewPrecision

ROOT = Path(__file__).parents[1]
START_SECONDS = 120.0
BATCH = 64


@dataclass
class Process:
    """A running service.

    ready: seconds from its start to the first 200 of ``/readyz``.
    """

    client: httpx.Client
    pid: int
    ready: float

    def peak_memory(self) -> float:
        """The most memory that it has had resident, in MB (10^6 bytes)."""
        return peak_memory(self.pid)


def peak_memory(pid: int) -> float:
    """The most memory that a process has had resident, in MB (10^6 bytes); 0 if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    kilobytes = next((line.split()[1] for line in lines if line.startswith("VmHWM:")), "0")
    return int(kilobytes) * 1024 / 1e6


@contextmanager
def service(
    data_dir: Path, threads: int = 0, settings: Mapping[str, object] | None = None, log: Path = Path("/dev/stderr")
) -> Iterator[Process]:
    """``placerec serve`` on a directory, until the block ends.

    Args:
        threads: of a forward pass, 0 for torch's choice.
        settings: others, by their variables without the prefix.
        log: where it logs to.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    own = {"DATA_DIR": data_dir, "THREADS": threads, "LOG_LEVEL": "warning", **(settings or {})}
    environment = {**os.environ, **{f"PLACEREC_{name}": str(value) for name, value in own.items()}}
    command = [sys.executable, "-m", "service.commands", "serve", "--host", "127.0.0.1", "--port", str(port)]
    began = time.monotonic()
    with log.open("ab") as opened:
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=opened)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client:
            yield Process(client, process.pid, _wait(client, process, began))
    finally:
        process.terminate()
        process.wait(60)


def _wait(client: httpx.Client, process: subprocess.Popen[bytes], began: float) -> float:
    while time.monotonic() - began < START_SECONDS and process.poll() is None:
        try:
            if client.get("/readyz").status_code == 200:
                return time.monotonic() - began
        except httpx.TransportError:
            pass
        time.sleep(0.01)
    raise RuntimeError("the service did not become ready")


def descriptors(
    encoder: Encoder, count: int, pictures: int = 60, seed: int = 0
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.int8]]]:
    """``count`` descriptors, float32 [D], with the statistics of real ones, and local descriptors, int8 [C, L].

    ``pictures`` are encoded; each further one takes the parts of its words, and its cells, from two of those at
    random.
    """
    encodings = [encoder.encode(sample_picture(index)) for index in range(min(pictures, count))]
    real = [(encoding.descriptor, encoding.local) for encoding in encodings]
    yield from real
    words, random = encoder.definition.words, np.random.default_rng(seed)
    for _ in range(count - len(real)):
        a, b = random.choice(len(real), 2, replace=False)
        from_a = random.random(words) < 0.5
        descriptor = np.where(from_a[:, None], real[a][0].reshape(words, -1), real[b][0].reshape(words, -1))
        cells_from_a = random.random(encoder.local_shape[0]) < 0.5
        yield descriptor.reshape(-1), np.where(cells_from_a[:, None], real[a][1], real[b][1])


def one_sequence(_index: int) -> PlaceFields:
    """All places are of one traverse, and nothing else is known of them."""
    return PlaceFields(sequence="benchmark")


def fill_map(
    data_dir: Path,
    map_id: str,
    encoder: Encoder,
    places: int,
    precision: NewPrecision = "half",
    fields: Callable[[int], PlaceFields] = one_sequence,
) -> None:
    """A map of so many places, written through the storage itself; ``fields`` tells what is said of each."""
    atlas = Atlas(data_dir)
    settings = MapSettings(keep="none")
    made = atlas.create(map_id, encoder.identity, encoder.dimension, settings, encoder.local_shape, precision=precision)
    batch: list[Enrolment] = []
    for index, (descriptor, local) in enumerate(descriptors(encoder, places)):
        batch.append(_enrolment(index, descriptor, local, fields(index)))
        if len(batch) == BATCH:
            made.enrol(batch)
            batch = []
    if batch:
        made.enrol(batch)
    atlas.close()


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


def median(values: Sequence[float]) -> float:
    """The median of a list."""
    return float(np.median(values))
