"""The stored keys, in a file of the data directory or in the PostgreSQL of all services.

A key has the form ``placerec_<id>_<secret>``.  Only its SHA-256 is stored: a slow hash protects secrets that a person
chose and others can guess, but 256 random bits cannot be guessed however fast a guess can be checked.

Each row has a checksum, and nobody is let in if one does not match.  What else fails closed is said by
:mod:`service.access.key_file`.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from sqlalchemy import bindparam, func, select, update

from core.ledger import Ledger, LedgerConnection, Statement
from core.ledger.statements import greatest
from core.names import word
from core.places import check_map_id
from service.access.key_file import KeyFile
from service.access.key_table import KEYS, KeyPlace, KeyTable
from service.access.roles import ANONYMOUS, LEVELS, NOBODY, OWNER, Role
from service.errors.faults import (
    InvalidRequest,
    KeyEnded,
    KeyExists,
    KeysUnreadable,
    KeyWidened,
    LastAdminKey,
    TooManyKeys,
    UnknownKey,
)

ID = re.compile(r"[0-9a-f]{12}")
NAME = re.compile(word(64, more="@"))
RESERVED = frozenset({ANONYMOUS.name, OWNER.name, NOBODY.name})
"""Names under which the audit trail has requests without a key, in small letters."""

SECRET_BYTES = 32

KeyState = Literal["in force", "revoked", "expired"]

MOST_KEYS = 10_000
"""Keys that a data directory may have, revoked ones included: a running service holds all of them in memory."""

LEARN = "+learn"
"""Behind the role of a key, as it is stored, from whose runs maps may learn."""

_ALL = Statement(select(KEYS).order_by(KEYS.c.created_at, KEYS.c.id))
_PUT = Statement(
    lambda insert: (put := insert(KEYS)).on_conflict_do_update(
        index_elements=["id"], set_={one.name: one for one in put.excluded if one.name != "id"}
    )
)
_USE = Statement(
    update(KEYS)
    .where(KEYS.c.id == bindparam("used"))
    .values(last_used_at=greatest(func.coalesce(KEYS.c.last_used_at, ""), bindparam("moment")))
)


@dataclass(frozen=True)
class Key:
    """A key without its secret.

    Args:
        id: 12 hexadecimal digits, which are part of the key.
        name: of the key's holder; unique among the keys in force, but for those that one of them replaces.
        role: of its holder.
        maps: ids of the maps that it is limited to; None for all maps.
        learn: whether maps may learn from the runs of its holder; only with the role ``enrol``, and ``admin`` has it.
        digest: SHA-256 of the whole key, as its holder sends it.
        created_at: when it was created.
        expires_at: when it expires; None for never.
        revoked_at: when it was revoked; None if it was not.
        last_used_at: roughly when it was last used, since this is written only from time to time.
    """

    id: str
    name: str
    role: Role
    maps: frozenset[str] | None
    digest: bytes
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    last_used_at: datetime | None = None
    learn: bool = False

    @property
    def teaches(self) -> bool:
        """Whether maps may learn from the runs of its holder."""
        return self.role == "admin" or self.learn

    def includes(self, other: Key) -> bool:
        """Whether its holder may do whatever the holder of ``other`` may do, and for as long."""
        of_maps = self.maps is None or (other.maps is not None and other.maps <= self.maps)
        as_long = self.expires_at is None or (other.expires_at is not None and other.expires_at <= self.expires_at)
        may = LEVELS[other.role] <= LEVELS[self.role] and other.teaches <= self.teaches
        return may and of_maps and as_long

    def seal(self) -> bytes:
        """The checksum of all fields but the last use."""
        values = [
            self.id,
            self.name,
            _stored_role(self),
            None if self.maps is None else sorted(self.maps),
            self.digest.hex(),
            *(text_of(moment) for moment in (self.created_at, self.expires_at, self.revoked_at)),
        ]
        return hashlib.sha256(json.dumps(values).encode()).digest()


def digest_of(token: bytes) -> bytes:
    """The SHA-256 of a key, which is all that is stored of its secret."""
    return hashlib.sha256(token).digest()


class Keys:
    """The stored keys; any number of processes may use them.

    All methods may raise KeysUnreadable: the keys are damaged, of a later version or writable by others, or the disk or
    server failed.

    place: the database that has their table.
    """

    def __init__(self, place: KeyPlace) -> None:
        self.place = place

    @classmethod
    def of(cls, directory: Path, ledger: Ledger | None = None) -> Keys:
        """The keys of a data directory; those that services share if they have a ledger."""
        return cls(KeyFile(directory) if ledger is None else KeyTable(ledger))

    def exists(self) -> bool:
        """Whether keys are needed, because one was ever created."""
        return self.place.exists()

    def all(self) -> list[Key]:
        """Every key that was ever created, the oldest first."""
        return [key_of(row) for row in self.place.execute(_ALL)]

    def note_uses(self, moments: Mapping[str, datetime]) -> None:
        """Store when keys were last used; an earlier time never replaces a later one."""
        with self.place.changing(announced=False) as connection:
            connection.execute_many(
                _USE, [{"used": identity, "moment": text_of(moment)} for identity, moment in sorted(moments.items())]
            )

    def create(
        self,
        name: str,
        role: Role,
        maps: Iterable[str] | None = None,
        expires_at: datetime | None = None,
        keep_admin: bool = False,
        learn: bool = False,
        replaces: str | None = None,
    ) -> tuple[Key, str]:
        """Create a key; return it and its text, which is not stored.  It is on disk when this returns.

        Args:
            learn: whether maps may learn from the runs of its holder.
            keep_admin: refuse a key after which none in force can manage the service.
            replaces: the id of a key in force, whose name this one may have, for that one is about to end.

        Raises:
            UnknownKey: there is no key that it ``replaces``.
            InvalidRequest: the name, the role or the expiry cannot be used.
            KeyExists: another key in force has the name.
            InvalidIdentifier: the id of a map is not valid.
            TooManyKeys, LastAdminKey.
        """
        if not NAME.fullmatch(name) or ID.fullmatch(name) or name.lower() in RESERVED:
            raise InvalidRequest(
                f"A key cannot have the name {name[:80]!r}. Use at most 64 letters, digits and . _ @ -."
            )
        if LEVELS.get(role, 0) < 1:
            raise InvalidRequest(f"{role!r} is not a role. Use query, enrol or admin.")
        if learn and role == "query":
            raise InvalidRequest("A key of the role query changes no map, so no map can learn from it. Use enrol.")
        limits = None if maps is None else frozenset(check_map_id(map_id) for map_id in maps)
        now = datetime.now(UTC)
        if expires_at is not None and expires_at <= now:
            raise InvalidRequest("The expiry of the key is in the past.")
        identity = secrets.token_hex(6)
        token = f"placerec_{identity}_{secrets.token_urlsafe(SECRET_BYTES)}"
        option = learn and role == "enrol"
        key = Key(identity, name, role, limits, digest_of(token.encode()), now, expires_at, learn=option)
        if not self.exists():
            if keep_admin:
                _check_admin([key], now)  # before there is a file, with which keys are needed
            self.place.prepare()
        with self.place.changing() as connection:
            keys = _read(connection)
            before = None if replaces is None else _of_id(keys, replaces)
            goes_on = before is not None and before.name == name and in_force(before, now)
            if not goes_on and any(other.name == name and in_force(other, now) for other in keys):
                raise KeyExists(f"There is already a key {name!r}. Delete it first, or choose another name.")
            if len(keys) >= MOST_KEYS:
                raise TooManyKeys(f"{MOST_KEYS} keys were created, which is the most that one data directory holds.")
            if keep_admin:
                _check_admin([*keys, key], now)
            connection.change(_PUT, **row_of(key))
        return key, token

    def find(self, key_id: str) -> Key:
        """The key of this id.

        Raises:
            UnknownKey: there is none.
        """
        return _of_id(self.all(), key_id)

    def narrow(self, key_id: str, changes: Mapping[str, Any], keep_admin: bool = False) -> Key:
        """Let the holder of a key do less, or for a shorter time.

        Args:
            changes: new values of ``role``, ``maps``, ``expires_at`` and ``learn``; fields that are left out stay.
            keep_admin: refuse to narrow the last key that can manage the service.

        Raises:
            UnknownKey, KeyEnded, LastAdminKey.
            KeyWidened: the holder could do more than before: a key keeps the terms on which it was given away.
            InvalidRequest: the expiry is in the past.
            InvalidIdentifier: the id of a map is not valid.
        """
        now = datetime.now(UTC)
        if not self.exists():
            raise _unknown(key_id)
        with self.place.changing() as connection:
            keys = _read(connection)
            before = _of_id(keys, key_id)
            if not in_force(before, now):
                raise KeyEnded(f"The key {before.name!r} is revoked or has expired; create another one.")
            after = _narrowed(before, changes)
            for map_id in after.maps or ():
                check_map_id(map_id)
            if not before.includes(after):
                raise KeyWidened(
                    f"The holder of the key {before.name!r} could do more than before. Create another key, and delete "
                    "this one."
                )
            if after.expires_at is not None and after.expires_at <= now:
                raise InvalidRequest("The expiry of the key is in the past. Delete it instead.")
            if keep_admin and is_admin(before):
                _check_admin([after if key is before else key for key in keys], now)
            connection.change(_PUT, **row_of(after))
        return after

    def revoke(self, id_or_name: str, keep_admin: bool = False) -> Key:
        """Revoke a key; it is no error if it is already revoked.

        Args:
            keep_admin: refuse to revoke the last key that can manage the service.

        Raises:
            UnknownKey: there is no such key.
            InvalidRequest: several keys have the name.
            LastAdminKey.
        """
        now = datetime.now(UTC)
        if not self.exists():
            raise UnknownKey("No key was ever created.")
        with self.place.changing() as connection:
            keys = _read(connection)
            found = [key for key in keys if key.id == id_or_name]
            found = found or [key for key in keys if key.name == id_or_name and key.revoked_at is None]
            found = found or [key for key in keys if key.name == id_or_name]
            if not found:
                raise _unknown(id_or_name)
            if len(found) > 1:
                raise InvalidRequest(f"Several keys have this name; give an id ({id_or_name[:80]!r}).")
            before = found[0]
            if before.revoked_at is not None:
                return before
            if keep_admin and is_admin(before) and in_force(before, now):
                _check_admin([key for key in keys if key is not before], now)
            key = replace(before, revoked_at=now)
            connection.change(_PUT, **row_of(key))
        return key


def state_of(key: Key, now: datetime) -> KeyState:
    """Whether a key is in force, revoked or expired at a moment."""
    if key.revoked_at is not None:
        return "revoked"
    return "expired" if key.expires_at is not None and key.expires_at <= now else "in force"


def in_force(key: Key, now: datetime) -> bool:
    """Whether a key is neither revoked nor expired at a moment."""
    return state_of(key, now) == "in force"


def is_admin(key: Key) -> bool:
    """Whether a key can manage the service: it has the role admin, and is not limited to maps."""
    return key.role == "admin" and key.maps is None


def _check_admin(keys: Iterable[Key], now: datetime) -> None:
    """Raise LastAdminKey if no key in force can manage the service."""
    if not any(is_admin(key) and in_force(key, now) for key in keys):
        raise LastAdminKey(
            "No key of the role admin for all maps would be in force, and only a command on the service's machine "
            "could create one. Create such an admin key first, or send ?lock_out=true."
        )


def _of_id(keys: Iterable[Key], key_id: str) -> Key:
    for key in keys:
        if key.id == key_id:
            return key
    raise _unknown(key_id)


def _unknown(id_or_name: str) -> UnknownKey:
    return UnknownKey(f"There is no such key ({id_or_name[:80]!r}).")


def _read(connection: LedgerConnection) -> list[Key]:
    """Every key, the oldest first.

    Raises:
        KeysUnreadable: a row is damaged.
    """
    return [key_of(row) for row in connection.execute(_ALL)]


def key_of(row: tuple[object, ...]) -> Key:
    """The key of a stored row.

    Raises:
        KeysUnreadable: the row is damaged.
    """
    try:
        key = _key(row)
    except (ValueError, TypeError) as error:
        raise KeysUnreadable(f"The keys are damaged: a row cannot be read ({error}).") from error
    if key.seal() != row[8]:
        raise KeysUnreadable(f"The keys are damaged: {key.id[:12]!r} does not match its checksum.")
    return key


def row_of(key: Key) -> dict[str, object]:
    """A key as it is stored."""
    return {
        "id": key.id,
        "name": key.name,
        "role": _stored_role(key),
        "maps": None if key.maps is None else json.dumps(sorted(key.maps)),
        "digest": key.digest,
        "created_at": text_of(key.created_at),
        "expires_at": text_of(key.expires_at),
        "revoked_at": text_of(key.revoked_at),
        "seal": key.seal(),
        "last_used_at": text_of(key.last_used_at),
    }


def _key(row: tuple[object, ...]) -> Key:
    identity, name, stored, maps, digest, created, expires, revoked, _, used = row
    role, learn, more = str(stored).partition(LEARN)
    if role not in LEVELS or more or (learn and role != "enrol") or not isinstance(digest, bytes):
        raise ValueError("its role or digest is none")
    return Key(
        id=str(identity),
        name=str(name),
        role=role,  # one of the roles, looked at above
        maps=None if maps is None else frozenset(json.loads(str(maps))),
        digest=digest,
        created_at=datetime.fromisoformat(str(created)),
        expires_at=None if expires is None else datetime.fromisoformat(str(expires)),
        revoked_at=None if revoked is None else datetime.fromisoformat(str(revoked)),
        last_used_at=None if used is None else datetime.fromisoformat(str(used)),
        learn=bool(learn),
    )


def _stored_role(key: Key) -> str:
    return key.role + (LEARN if key.learn else "")


def _narrowed(key: Key, changes: Mapping[str, Any]) -> Key:
    """A key after changes; without the role ``enrol`` it has not its option, which ``admin`` includes.

    Raises:
        InvalidRequest: the role cannot have the option.
    """
    after = replace(key, **changes)
    if changes.get("learn") and after.role == "query":
        raise InvalidRequest("A key of the role query changes no map, so no map can learn from it.")
    if changes.get("learn") is False and after.role == "admin":
        raise InvalidRequest("The role admin includes that maps learn from its runs; give the key the role enrol, too.")
    kept = after.learn or (key.role == "admin" and "learn" not in changes)
    return replace(after, learn=after.role == "enrol" and kept)


def text_of(moment: datetime | None) -> str | None:
    return None if moment is None else moment.astimezone(UTC).isoformat(timespec="microseconds")
