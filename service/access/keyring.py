"""The keys as a running service knows them: in memory, looked at anew when their file changes.

No request reads the file.  A thread looks four times a second whether it has changed, so that a key that was created
or revoked beside the service counts within a second.  When the file cannot be read, what was known holds for some
seconds, since another process may just be writing; then nobody is let in.

Whether a key has expired is told by two clocks.  The system's may be set back, which would make an expired key valid
again; so a key also ages by the monotonic clock, from the latest moment that the file proves of it (its creation or
its last use).  A clock that jumps can thus end keys early, for as long as it is wrong, but not prolong their use.
"""

from __future__ import annotations

import hmac
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime

from service.access.keys import Key, KeyStore, digest_of, read_keys
from service.access.principals import TOKEN, Principal
from service.errors.faults import KeyNeeded, KeyRefused, KeysUnreadable

LOOK_SECONDS = 0.25
USE_SECONDS = 60.0
"""Last uses are written down so often."""

GRACE_SECONDS = 5.0
"""So long what was known holds while the file cannot be read."""

STUCK_SECONDS = 30.0
"""So long the thread may take over one look."""

NOBODY = bytes(32)
"""What an unknown key is compared with."""

log = logging.getLogger("placerec.access")


@dataclass
class Held:
    """A key in memory.

    expires: seconds since the epoch; None: never.
    deadline: the same of the monotonic clock.
    """

    key: Key
    principal: Principal
    expires: float | None
    deadline: float | None


@dataclass(frozen=True)
class _File:
    """The file as it was read last: its connection, what the system says of it, SQLite's count of changes."""

    connection: sqlite3.Connection
    traits: tuple[int, ...]
    changes: int


@dataclass
class _Known:
    """What holds now; replaced as a whole.

    demanded: keys are needed.
    broken: why nobody can be let in.
    """

    demanded: bool = False
    broken: str | None = None
    held: dict[bytes, Held] = field(default_factory=dict)


class Keyring:
    """The keys of a service; from any thread.

    Args:
        store: the file.
        wall, monotonic: the clocks, in seconds.
    """

    def __init__(
        self,
        store: KeyStore,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self.store, self._wall, self._monotonic = store, wall, monotonic
        self._known = _Known()
        self._file: _File | None = None
        self._read_at = self._looked_at = monotonic()
        self._used: dict[str, float] = {}
        self._written_at = monotonic()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def demanded(self) -> bool:
        """Whether a request needs a key."""
        return self._known.demanded

    def start(self) -> None:
        """Read the file, and look at it again and again.

        Raises:
            KeysUnreadable: it is there, and cannot be read.
        """
        self._read()
        self._thread = threading.Thread(target=self._watch, name="keys", daemon=True)
        self._thread.start()

    def __enter__(self) -> Keyring:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write down the last uses, and let the file go."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
        with suppress(KeysUnreadable):
            self._write_uses()
        self._forget_file()

    def principal(self, authorization: bytes | None) -> Principal:
        """Who sends an ``Authorization`` header.

        Raises:
            KeyNeeded: there is none, or it is not of the form ``Bearer placerec_…``.
            KeyRefused: its key is unknown, expired or revoked.
            KeysUnreadable: nobody can tell.
        """
        known = self._known
        if known.broken is not None:
            raise KeysUnreadable(f"{known.broken} Nobody is let in until it can be read.")
        if self._thread is not None and self._monotonic() - self._looked_at > STUCK_SECONDS:
            raise KeysUnreadable("The disk does not answer, so nobody can tell which keys are in force.")
        if authorization is None:
            raise KeyNeeded("The request carries no key: send it as 'Authorization: Bearer placerec_…'.")
        scheme, _, token = authorization.strip().partition(b" ")
        token = token.strip()
        found = TOKEN.fullmatch(token.decode("latin-1"))
        if scheme.lower() != b"bearer" or found is None:
            raise KeyNeeded("The key is sent as 'Authorization: Bearer placerec_…', whole and unchanged.")
        held = known.held.get(found[1].encode())
        # An unknown id costs what a known one does.
        is_right = hmac.compare_digest(digest_of(token), NOBODY if held is None else held.key.digest)
        if held is None or not is_right:
            raise KeyRefused("The key is not one of this service.")
        if held.key.revoked_at is not None:
            raise KeyRefused(f"The key {held.key.name!r} was revoked.")
        now = self._wall()
        if held.expires is not None and held.deadline is not None:
            now = max(now, held.expires - held.deadline + self._monotonic())
            if now >= held.expires:
                raise KeyRefused(f"The key {held.key.name!r} has expired.")
        self._used[held.key.id] = now
        return held.principal

    # The thread

    def _watch(self) -> None:
        while not self._stopping.wait(LOOK_SECONDS):
            self.look()

    def look(self) -> None:
        """Read the file if it has changed, and write down now and then when keys were used."""
        self._looked_at = self._monotonic()
        try:
            if self._has_changed():
                self._read()
            self._read_at = self._monotonic()
            if self._known.broken is not None:
                log.warning("the keys can be read again")
                self._read()
            if self._monotonic() - self._written_at >= USE_SECONDS:
                self._written_at = self._monotonic()
                self._write_uses()
        except Exception as error:  # whatever it is, the keys that hold now must not hold for ever
            self._forget_file()
            if self._known.broken is None and self._monotonic() - self._read_at >= GRACE_SECONDS:
                log.error("nobody is let in: %s", error)
                self._known = _Known(demanded=True, broken=str(error))

    def _has_changed(self) -> bool:
        file = self._file
        try:
            status = os.stat(self.store.path)
        except FileNotFoundError:
            if self._known.demanded:
                raise KeysUnreadable(f"{self.store.path} is gone.") from None
            return False
        except OSError as error:
            raise KeysUnreadable(f"{self.store.path} cannot be looked at: {error.strerror}.") from error
        if file is None or file.traits != _traits(status):
            return True
        try:
            return _changes(file.connection) != file.changes
        except sqlite3.Error as error:
            raise KeysUnreadable(f"{self.store.path} cannot be read: {error}.") from error

    def _read(self) -> None:
        if not self.store.exists():
            return
        self._forget_file()
        connection = self.store.open()
        try:
            status = os.stat(self.store.path)
            changes = _changes(connection)
            keys = read_keys(connection)
        except (OSError, sqlite3.Error) as error:
            connection.close()
            raise KeysUnreadable(f"{self.store.path} cannot be read: {error}.") from error
        except BaseException:
            connection.close()
            raise
        self._file = _File(connection, _traits(status), changes)
        before = self._known.held
        held = {key.id.encode(): self._hold(key, before.get(key.id.encode())) for key in keys}
        if not self._known.demanded:
            log.info("keys are demanded", extra={"keys": len(keys)})
        self._known = _Known(demanded=True, held=held)

    def _hold(self, key: Key, before: Held | None) -> Held:
        principal = Principal(key.name, key.id, key.role, key.maps)
        if key.expires_at is None:
            return Held(key, principal, None, None)
        expires = key.expires_at.timestamp()
        proven = max(moment.timestamp() for moment in (key.created_at, key.last_used_at) if moment is not None)
        deadline = self._monotonic() + expires - max(self._wall(), proven)
        if before is not None and before.deadline is not None and before.expires == expires:
            deadline = min(deadline, before.deadline)
        return Held(key, principal, expires, deadline)

    def _write_uses(self) -> None:
        before, self._used = self._used, {}
        used = before.copy()  # at one go: a request may still be writing to it
        if not used:
            return
        try:
            self.store.note_uses({identity: datetime.fromtimestamp(moment, UTC) for identity, moment in used.items()})
        except KeysUnreadable as error:
            log.warning("when keys were used cannot be written down: %s", error)

    def _forget_file(self) -> None:
        if self._file is not None:
            self._file.connection.close()
            self._file = None


def _traits(status: os.stat_result) -> tuple[int, ...]:
    """What differs when a file was replaced, or written to by other means than SQLite's."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_mode


def _changes(connection: sqlite3.Connection) -> int:
    """A number that differs when another connection has changed the file."""
    (found,) = connection.execute("PRAGMA data_version").fetchone()
    return int(found)
