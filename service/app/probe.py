"""The outcome of a check that may wait for a disk or a server, for those who must not."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from core.errors import PlacerecError
from service.worker_threads import in_thread

ANSWER_SECONDS = 1.0
"""How long a caller waits for an outcome."""

WRONG_SECONDS = 1.0
"""How long it counts that something is wrong."""


class Probe:
    """Runs a check in a thread, one at a time, and remembers its outcome for a while.

    Args:
        check: raises a PlacerecError if something is wrong.
        seconds: how long it counts that nothing is wrong; anything else counts for ``WRONG_SECONDS``.
        silent: the outcome while the check takes longer than ``ANSWER_SECONDS``.
    """

    def __init__(self, check: Callable[[], None], seconds: float, silent: str) -> None:
        self._check, self._seconds, self._silent = check, seconds, silent
        self._task: asyncio.Task[str] | None = None
        self._began = 0.0

    async def outcome(self) -> str:
        """ "ok", or what is wrong, within ``ANSWER_SECONDS``."""
        task = self._task
        seconds = self._seconds if task is None or not task.done() or task.result() == "ok" else WRONG_SECONDS
        if task is None or (task.done() and time.monotonic() - self._began > seconds):
            self._began = time.monotonic()
            task = self._task = asyncio.create_task(in_thread(self._run))
        await asyncio.wait({task}, timeout=ANSWER_SECONDS)
        return task.result() if task.done() else self._silent

    def _run(self) -> str:
        try:
            self._check()
        except PlacerecError as error:
            return str(error)
        return "ok"
