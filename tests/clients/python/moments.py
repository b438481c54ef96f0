"""A clock of which a test says when it goes on."""

from __future__ import annotations

import pytest

from placerec_client import retry
from placerec_client._sync import client, connection, numbering


class Moments:
    """A clock that only goes on while the client pauses; the client's own waits for it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr(retry, "time", self)
        monkeypatch.setattr(numbering, "time", self)
        monkeypatch.setattr(connection, "sleep", self.sleep)
        monkeypatch.setattr(client, "sleep", self.sleep)

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
