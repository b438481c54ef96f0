"""Whether the services that share state are alike: in the settings that callers notice, their encoders and the time.

Where they are not, all of them go on: which one is right, only an operator knows, and while a fleet is being upgraded
they differ for a while.  It is said in the log and by ``/readyz``.
"""

from __future__ import annotations

import importlib.metadata
import json
import logging
import math
import socket
import time
from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import bindparam, select, update

from core.ledger import Ledger, Statement
from core.ledger.statements import seconds_now
from core.method.catalogue import EncoderCatalogue
from service.peers.replica import GONE_SECONDS, IS_LIVING, REPLICAS
from service.settings import Settings

COMMON = (
    "encoder",
    "rate_per_key",
    "rate_burst",
    "request_timeout",
    "job_queue",
    "job_history",
    "session_expiry",
    "thumbnail_side",
    "max_maps",
    "max_places",
    "max_image_bytes",
    "max_image_pixels",
    "max_batch_items",
    "max_batch_bytes",
    "max_bulk_items",
    "max_bulk_bytes",
    "max_json_bytes",
    "max_metadata_bytes",
    "max_import_bytes",
    "max_similarity_pairs",
    "max_sessions",
)
"""Settings that all services should have alike, for a caller does not know which one answers."""

READ_SECONDS = 30.0
"""How often it is looked up which encoders are installed."""

CLOCK_SECONDS = 2.0
"""A clock that is off by more is reported."""

Difference = tuple[str, str, str]
"""A difference in a sentence; the same without the address of another service; and the values."""

log = logging.getLogger("placerec.shared")

_WRITE = Statement(update(REPLICAS).where(REPLICAS.c.id == bindparam("service")).values(settings=bindparam("text")))
_READ = Statement(select(REPLICAS.c.id, REPLICAS.c.settings, seconds_now()).where(IS_LIVING).order_by(REPLICAS.c.id))


class ReplicaDifferences:
    """Tells the other services what this one has, and compares it with what they have.

    state: "ok", or what differs, in a sentence.
    public_state: the same without the addresses of the others.

    Args:
        replica: the id of this service.
    """

    def __init__(self, settings: Settings, database: Ledger, replica: str) -> None:
        self._settings, self._database, self._replica = settings, database, replica
        self._catalogue = EncoderCatalogue(settings.models_directory)
        self._written: str | None = None
        self._mine, self._read = dict[str, Any](), -math.inf
        self.state = self.public_state = "ok"

    def compare(self) -> None:
        """Tell and compare.

        Raises:
            StorageFailure: PostgreSQL cannot be reached, or refuses.
        """
        if time.monotonic() - self._read > READ_SECONDS:
            self._mine, self._read = self._read_mine(), time.monotonic()
        mine = self._mine
        if (text := json.dumps(mine)) != self._written:
            self._database.execute("tell its settings", _WRITE, service=self._replica, text=text)
            self._written = text
        sent = time.time()
        found = self._database.execute("compare settings", _READ, gone=GONE_SECONDS)
        answered = time.time()
        differences = [
            difference
            for name, theirs, _ in found
            if name != self._replica and theirs is not None
            for difference in _differences(mine, json.loads(theirs), name)
        ]
        if found and (late := _off_by(found[0][2], sent, answered)):
            away = f"{abs(late):.0f} s {'behind' if late > 0 else 'ahead of'} PostgreSQL's"
            off = f"The clock of this machine is {away}"
            differences.append((off, off, "keys expire by it"))
        self._note(differences)

    def _read_mine(self) -> dict[str, Any]:
        chosen = {name: getattr(self._settings, name) for name in COMMON}
        encoders = sorted(one.identity for one in self._catalogue.describe() if one.damaged is None)
        where = f"{socket.gethostname()}:{self._settings.port}"
        return {"at": where, "version": importlib.metadata.version("placerec"), "encoders": encoders, **chosen}

    def _note(self, differences: list[Difference]) -> None:
        before = self.state
        self.state, self.public_state = (_together(one[at] for one in differences) for at in (0, 1))
        if self.state == before:
            return
        if not differences:
            log.info("the services are alike again")
        for difference, _, details in differences:
            log.warning("%s: %s", difference, details)


def _together(sentences: Iterable[str]) -> str:
    return f"{said}." if (said := "; ".join(sentences)) else "ok"


def _differences(mine: Mapping[str, Any], theirs: Mapping[str, Any], name: str) -> list[Difference]:
    """The differing settings, and their values."""
    said, other = "{} is not that of {}", f"{name} ({theirs.get('at')})"
    return [
        (said.format(key, other), said.format(key, "another service"), f"{value} here, {theirs.get(key)} there")
        for key, value in mine.items()
        if key != "at" and theirs.get(key) != value
    ]


def _off_by(theirs: float, sent: float, answered: float) -> float:
    """Seconds by which PostgreSQL's clock is ahead of ours; 0 if that is little, or could be the time of the answer."""
    if sent - CLOCK_SECONDS <= theirs <= answered + CLOCK_SECONDS:
        return 0.0
    return theirs - (sent + answered) / 2
