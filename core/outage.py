"""Remembering that a server cannot be reached, so that not every request waits until it knows that by itself."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from core.errors import StoreUnavailable

PROBED_AGAIN_SECONDS = 0.5
"""A server that could not be reached is probed again after this time, by one request at a time."""

log = logging.getLogger(__name__)


class Unreachable(StoreUnavailable):
    """One server cannot be reached, or refuses.

    Args:
        server: its name, with which the text begins.
        text: what it does; the words of others, which may name addresses, follow a colon.
    """

    def __init__(self, server: str, text: str) -> None:
        super().__init__(f"{server} {text}")
        self.server = server
        self.public = f"{server} {text.partition(': ')[0].removesuffix('.')}."


class Outage:
    """Whether one server can be reached, or does one thing.  Any thread may use it.

    Args:
        name: of the server, as its :class:`Unreachable` names it.
        thing: the name in the log; by default that of the server.
        probe: finds out quickly whether a server that was gone is back, before any other request; raises
            Unreachable if it is not.
    """

    def __init__(self, name: str, thing: str | None = None, probe: Callable[[], None] = lambda: None) -> None:
        self._name, self._thing, self._probe = name, thing or name, probe
        self._lock = threading.Lock()
        self._reason: str | None = None
        self._ask_at = 0.0

    @contextmanager
    def noticed(self) -> Iterator[None]:
        """Ask the server something in the block.

        Raises:
            Unreachable: it could not be reached a moment ago, and the block is not run; or the block raises it.
        """
        must_probe = self._expect_up()
        try:
            if must_probe:
                self._probe()
            yield
        except BaseException as error:
            down = isinstance(error, Unreachable) and error.server == self._name
            self._note(str(error) if down else None)
            raise
        self._note(None)

    def _expect_up(self) -> bool:
        """Whether it must be probed, as after an outage."""
        if self._reason is None:
            return False
        with self._lock:
            if self._reason is None:
                return False
            if time.monotonic() < self._ask_at:
                raise Unreachable(self._name, self._reason.removeprefix(f"{self._name} "))
            self._ask_at = time.monotonic() + 60  # others are refused until this request knows more
            return True

    def _note(self, reason: str | None) -> None:
        if reason is None and self._reason is None:
            return
        with self._lock:
            before, self._reason = self._reason, reason
            self._ask_at = time.monotonic() + PROBED_AGAIN_SECONDS
        if reason is not None and before is None:
            log.error("%s is unavailable: %s", self._thing, reason)
        elif reason is None and before is not None:
            log.info("%s is available again", self._thing)
