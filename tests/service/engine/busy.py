"""Encoder threads that are at work until a test lets them go on."""

from __future__ import annotations

import threading
import time

from core.method.encoder import Encoder
from core.threads import allowed_threads
from service.engine.encoder_threads import EncoderThreads
from service.engine.encoders import Encoded, QueuedFrame
from tests.service.scenes import jpeg


def keep_busy(encoders: EncoderThreads, encoder: Encoder) -> tuple[list[QueuedFrame], threading.Event]:
    """Give every thread a frame that it does not finish until the event is set; those frames, and the event."""
    done, begun = threading.Event(), threading.Semaphore(0)

    def wait(_: Encoded) -> None:
        begun.release()
        done.wait(60)

    frames = [
        QueuedFrame(encoder, jpeg(0), None, time.monotonic() + 60, after_encoding=wait)
        for _ in range(allowed_threads())
    ]
    encoders.put(frames)
    for _ in frames:
        assert begun.acquire(timeout=60)
    return frames, done
