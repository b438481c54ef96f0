"""The finding of a check that may wait for a disk or a server, for those who must not."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import NamedTuple

from core.errors import PlacerecError, StorageFull
from service.errors.problems import told
from service.worker_threads import in_thread

ANSWER_SECONDS = 1.0
"""How long a caller waits for a finding."""

WRONG_SECONDS = 1.0
"""How long it counts that something is wrong."""


class Finding(NamedTuple):
    """The finding of a check.

    text: "ok", or what is wrong.
    public: the same for those who may not know addresses, paths and peers of the installation.
    is_full: whether nothing is wrong but that there is no room to write.
    """

    text: str = "ok"
    public: str = "ok"
    is_full: bool = False

    @classmethod
    def of(cls, state: str, public: str) -> Finding:
        """The finding of a state, "ok" or what is wrong."""
        return cls() if state == "ok" else cls(state, public)

    def told(self, confided: bool) -> str:
        """The text for those who may know addresses, or for those who may not."""
        return self.text if confided else self.public


class Probe:
    """Runs a check in a thread, one at a time, and remembers its finding for a while.

    Args:
        check: raises a PlacerecError if something is wrong.
        seconds: how long it counts that nothing is wrong; anything else counts for ``WRONG_SECONDS``.
        silent: the finding while the check takes longer than ``ANSWER_SECONDS``.
    """

    def __init__(self, check: Callable[[], None], seconds: float, silent: str) -> None:
        self._check, self._seconds, self._silent = check, seconds, Finding(silent, silent)
        self._task: asyncio.Task[Finding] | None = None
        self._began = 0.0

    async def finding(self) -> Finding:
        """The finding of the latest check, within ``ANSWER_SECONDS``."""
        task = self._task
        seconds = self._seconds if task is None or not task.done() or task.result() == Finding() else WRONG_SECONDS
        if task is None or (task.done() and time.monotonic() - self._began > seconds):
            self._began = time.monotonic()
            task = self._task = asyncio.create_task(in_thread(self._run))
        await asyncio.wait({task}, timeout=ANSWER_SECONDS)
        return task.result() if task.done() else self._silent

    def _run(self) -> Finding:
        try:
            self._check()
        except PlacerecError as error:
            return Finding(str(error), told(error, False), isinstance(error, StorageFull))
        return Finding()
