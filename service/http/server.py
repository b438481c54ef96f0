"""The server from its first signal to its last answer."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from socket import socket
from types import FrameType

import uvicorn

log = logging.getLogger("placerec.server")

LAST_WORD_SECONDS = 1.0
"""So long a request that is given up has to be told so."""


class DrainingServer(uvicorn.Server):
    """A server that is taken out of service before it stops.

    The first SIGTERM or SIGINT: ``on_signal`` is called at once, and for ``drain_seconds`` everything is still
    answered.  Then ``on_stop`` is called, nothing new is taken, and what is under way has the configured time.  A
    second signal ends the waiting.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        drain_seconds: float,
        on_signal: Callable[[], None],
        on_stop: Callable[[], None],
    ) -> None:
        super().__init__(config)
        self._drain_seconds, self._on_signal, self._on_stop = drain_seconds, on_signal, on_stop
        self._stop_at: float | None = None

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Note a signal; called between two instructions of the event loop's thread, so it only sets values."""
        self._captured_signals.append(sig)
        if self._stop_at is None:
            self._on_signal()
            self._stop_at = time.monotonic() + self._drain_seconds
        else:
            self._stop_at, self.force_exit = time.monotonic(), True
        self.should_exit = time.monotonic() >= self._stop_at

    async def on_tick(self, counter: int) -> bool:
        """Whether to stop now; called several times a second."""
        if self._stop_at is not None and time.monotonic() >= self._stop_at:
            self.should_exit = True
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket] | None = None) -> None:
        """Take nothing new, and give what is under way its time."""
        self._on_stop()
        await super().shutdown(sockets)
        # Those that are given up say so before the loop ends.
        tasks = [task for task in self.server_state.tasks if not task.done()]
        if tasks:
            log.warning("requests are given up", extra={"requests": len(tasks)})
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks, timeout=LAST_WORD_SECONDS)
