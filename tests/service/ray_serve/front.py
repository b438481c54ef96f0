"""A front in a process of its own, which Ray may end when the machine's part of the cluster is gone.

    python -m tests.service.ray_serve.front ADDRESS FOLDER

encodes a picture for each line of its input, the number of a scene, and answers with the SHA-256 of its descriptor, or
with nothing if it is refused.
"""

from __future__ import annotations

import asyncio
import hashlib
import subprocess
import sys
import time
from pathlib import Path
from typing import Self

from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue

PATIENCE = 60.0
"""Seconds that a frame may wait."""


class Front:
    """The process; one that has ended is started again, as what supervises a service does."""

    def __init__(self, address: str, folder: Path) -> None:
        self._arguments = [sys.executable, "-m", "tests.service.ray_serve.front", address, str(folder)]
        self._process = self._started()

    def _started(self) -> subprocess.Popen[str]:
        root = Path(__file__).parents[3]
        return subprocess.Popen(self._arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=root)

    def ask(self, scene: int) -> str:
        """The descriptor's SHA-256, or nothing."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(f"{scene}\n")
            self._process.stdin.flush()
            for line in self._process.stdout:
                if line.startswith("answer "):
                    return line.split(" ", 1)[1].strip()
        except BrokenPipeError:
            pass
        self._process.wait()
        self._process = self._started()
        return ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._process.kill()
        self._process.wait()


async def main(address: str, folder: Path) -> None:
    """Encode what is asked for."""
    from core.frames.images import Limits
    from service.engine.queue import EncoderQueue, RequestDeadline
    from service.errors.faults import NotReady
    from service.ray_serve import encoders_for
    from service.settings import Settings
    from service.telemetry.metrics import Metrics
    from tests.service.ray_serve.robots import stays
    from tests.service.scenes import jpeg

    settings = Settings(
        data_dir=folder / "data",
        ray=True,
        ray_address=address,
        ray_replicas=1,
        ray_max_replicas=1,
    )
    catalogue = EncoderCatalogue()
    queue = EncoderQueue(catalogue, Limits(), 64, 0, Metrics(), encoders_for(settings))
    identity = catalogue.resolve(DEFAULT_ENCODER)
    while line := await asyncio.to_thread(sys.stdin.readline):
        try:
            deadline = RequestDeadline(time.monotonic() + PATIENCE, stays)
            found = await queue.encode(identity, jpeg(int(line)), deadline)
        except NotReady:
            print("answer ", flush=True)
        else:
            print("answer", hashlib.sha256(found.encoding.descriptor.tobytes()).hexdigest(), flush=True)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], Path(sys.argv[2])))
