"""The keys in the memory of a running service, which are read again whenever their file changes.

No request reads the file.  A thread checks four times a second whether it has changed, so that a key that a command
creates or revokes counts within a second.  If the file cannot be read, the known keys hold for some seconds more,
since another process may just be writing; after that nobody is let in.

Two clocks decide whether a key has expired.  The system clock may be set back, which would make an expired key valid
again; so a key also ages by the monotonic clock, from the latest moment that the file proves for it (its creation or
its last use).  A wrong system clock can therefore end a key early, while it is wrong, but never prolong it.
"""

from __future__ import annotations

import hmac
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime

from service.access.keys import Key, Keys, digest_of
from service.access.roles import TOKEN, Principal
from service.errors.faults import KeyNeeded, KeyRefused, KeysUnreadable

LOOK_SECONDS = 0.25
USE_SECONDS = 60.0
"""How often the last uses are written to the file."""

GRACE_SECONDS = 5.0
"""How long the known keys hold while the file cannot be read."""

STUCK_SECONDS = 30.0
"""How long the thread may take to check the file."""

NO_DIGEST = bytes(32)
"""The digest that an unknown key is compared with."""

log = logging.getLogger("placerec.access")


@dataclass
class HeldKeys:
    """A key in memory.

    Args:
        key: as it is stored.
        principal: its holder.
        expires: seconds since the epoch; None if it never expires.
        deadline: the same moment by the monotonic clock.
    """

    key: Key
    principal: Principal
    expires: float | None
    deadline: float | None


@dataclass
class _Known:
    """The keys as they were read; replaced as a whole.

    Args:
        demanded: whether a request needs a key.
        broken: why nobody can be let in; None if the keys are known.
        held: the keys by their ids.
    """

    demanded: bool = False
    broken: str | None = None
    held: dict[bytes, HeldKeys] = field(default_factory=dict)


class Keyring:
    """The keys of a service.  It may be used from any thread.

    Args:
        store: the stored keys.
        wall, monotonic: the clocks, in seconds.
        may_open: whether everybody may be let in while there are no keys; else nobody is, if that is learnt only after
            the start.
    """

    def __init__(
        self,
        store: Keys,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
        may_open: bool = True,
    ) -> None:
        self.store, self._wall, self._monotonic = store, wall, monotonic
        self._known = _Known()
        self._may_open, self._seen_keys = may_open, False
        self._version: object = None
        self._read_at = self._looked_at = monotonic()
        self._used: dict[str, float] = {}
        self._written_at = monotonic()
        self._looking = threading.Lock()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def demanded(self) -> bool:
        """Whether a request needs a key."""
        return self._known.demanded

    @property
    def state(self) -> str:
        """ "ok", or why nobody can be let in."""
        return self._known.broken or "ok"

    def start(self) -> None:
        """Read the keys, and start the thread that watches them.

        Nobody is let in until they can be read, if they are on a server that cannot be reached.

        Raises:
            KeysUnreadable: their file exists but cannot be read.
        """
        try:
            self._read()
        except KeysUnreadable as error:
            if not self.store.place.remote:
                raise
            log.error("nobody is let in: %s", error)
            self._known = _Known(demanded=True, broken=str(error))
        self._thread = threading.Thread(target=self._watch, name="keys", daemon=True)
        self._thread.start()

    def __enter__(self) -> Keyring:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the thread, write the last uses to the file, and close it."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
        with suppress(KeysUnreadable):
            self._write_uses()
        self.store.place.close()

    def principal(self, authorization: bytes | None) -> Principal:
        """The holder of the key in an ``Authorization`` header.

        Raises:
            KeyNeeded: there is no header, or it has no key behind ``Bearer``.
            KeyRefused: the key is unknown, cut, expired or revoked.
            KeysUnreadable: the keys are not known, because their file cannot be read.
        """
        known = self._known
        if known.broken is not None:
            raise KeysUnreadable(f"{known.broken} Nobody is let in until the keys can be read.")
        if self._thread is not None and self._monotonic() - self._looked_at > STUCK_SECONDS:
            raise KeysUnreadable("The disk does not respond, so it is unknown which keys are in force.")
        if authorization is None:
            raise KeyNeeded("The request carries no key: send it as 'Authorization: Bearer placerec_…'.")
        scheme, _, token = authorization.strip().partition(b" ")
        token = token.strip()
        found = TOKEN.fullmatch(token.decode("latin-1"))
        if scheme.lower() != b"bearer" or not token:
            raise KeyNeeded("Send the whole key in the header 'Authorization: Bearer placerec_…'.")
        if found is None:
            raise KeyRefused("This key is not known: it is no whole key of the form placerec_….")
        held = known.held.get(found[1].encode())
        # The comparison takes the same time for an unknown id.
        is_right = hmac.compare_digest(digest_of(token), NO_DIGEST if held is None else held.key.digest)
        if held is None or not is_right:
            raise KeyRefused("This key is not known.")
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
        """Read the file if it has changed, and write the last uses to it from time to time.

        Whoever changes a key in this process calls this, so that the change counts at once.
        """
        with self._looking:
            self._look()

    def _look(self) -> None:
        self._looked_at = self._monotonic()
        try:
            if self.store.place.version(expected=self._known.demanded) != self._version:
                self._read()
            self._read_at = self._monotonic()
            if self._known.broken is not None:
                log.warning("the keys can be read again")
                self._read()
            if self._monotonic() - self._written_at >= USE_SECONDS:
                self._written_at = self._monotonic()
                self._write_uses()
        except Exception as error:  # whatever the error is, the known keys must not hold for ever
            self.store.place.close()
            if self._known.broken is None and self._monotonic() - self._read_at >= GRACE_SECONDS:
                log.error("nobody is let in: %s", error)
                self._known = _Known(demanded=True, broken=str(error))

    def _read(self) -> None:
        version = self.store.place.version(expected=False)  # before the keys: later changes are read again
        keys = self.store.all() if self.store.exists() else None
        self._version = version
        if keys is None:
            if self._known.broken is not None and not self._seen_keys:
                self._known = _Known(demanded=not self._may_open)
            return
        self._seen_keys = True
        before = self._known.held
        held = {key.id.encode(): self._hold(key, before.get(key.id.encode())) for key in keys}
        if not self._known.demanded:
            log.info("keys are demanded", extra={"keys": len(keys)})
        self._known = _Known(demanded=True, held=held)

    def _hold(self, key: Key, before: HeldKeys | None) -> HeldKeys:
        principal = Principal(key.name, key.id, key.role, key.maps, key.learn)
        if key.expires_at is None:
            return HeldKeys(key, principal, None, None)
        expires = key.expires_at.timestamp()
        proven = max(moment.timestamp() for moment in (key.created_at, key.last_used_at) if moment is not None)
        deadline = self._monotonic() + expires - max(self._wall(), proven)
        if before is not None and before.deadline is not None and before.expires == expires:
            deadline = min(deadline, before.deadline)
        return HeldKeys(key, principal, expires, deadline)

    def _write_uses(self) -> None:
        before, self._used = self._used, {}
        used = before.copy()  # in one step, because a request may still write to it
        if not used:
            return
        try:
            self.store.note_uses({identity: datetime.fromtimestamp(moment, UTC) for identity, moment in used.items()})
        except KeysUnreadable as error:
            log.warning("when keys were used cannot be written down: %s", error)
