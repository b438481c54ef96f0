"""The stored keys: one small SQLite file in the data directory, apart from the maps and not under their lock.

A key has the form ``placerec_<id>_<secret>``.  Only its SHA-256 is stored: a slow hash protects secrets that a person
chose and others can guess, but 256 random bits cannot be guessed however fast a guess can be checked.

The file fails closed.  If it exists, keys are needed, whatever it contains; each row has a checksum; and nobody is let
in if the file is empty, damaged, of a later version, or writable by others.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import sqlite3
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

from core.disk.files import Damage, sync_folder
from core.disk.sqlite_file import NotOurs, Schema, SqliteFile, UnreadVersion, connect, transaction
from core.names import word
from core.places import check_map_id
from service.access.roles import LEVELS, Role
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

FILE = "keys.sqlite"
MODE = 0o600
BUSY_SECONDS = 5.0

ID = re.compile(r"[0-9a-f]{12}")
NAME = re.compile(word(64, more="@"))
RESERVED = frozenset({"anonymous", "owner"})
SECRET_BYTES = 32

KeyState = Literal["in force", "revoked", "expired"]

MOST_KEYS = 10_000
"""Keys that a data directory may have, revoked ones included: a running service holds all of them in memory."""

_TABLE = """CREATE TABLE keys (
    id TEXT PRIMARY KEY,
    name TEXT NOT NULL,
    role TEXT NOT NULL,
    maps TEXT,
    digest BLOB NOT NULL,
    created_at TEXT NOT NULL,
    expires_at TEXT,
    revoked_at TEXT,
    seal BLOB NOT NULL,
    last_used_at TEXT
) STRICT"""
_SCHEMA = Schema(application_id=0x706C6B79, version=1, create=[_TABLE])  # "plky"
COLUMNS = ("id", "name", "role", "maps", "digest", "created_at", "expires_at", "revoked_at", "seal", "last_used_at")


@dataclass(frozen=True)
class Key:
    """A key without its secret.

    Args:
        id: 12 hexadecimal digits, which are part of the key.
        name: of the key's holder; unique among the keys in force.
        role: of its holder.
        maps: ids of the maps that it is limited to; None for all maps.
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

    def includes(self, other: Key) -> bool:
        """Whether its holder may do whatever the holder of ``other`` may do, and for as long."""
        of_maps = self.maps is None or (other.maps is not None and other.maps <= self.maps)
        as_long = self.expires_at is None or (other.expires_at is not None and other.expires_at <= self.expires_at)
        return LEVELS[other.role] <= LEVELS[self.role] and of_maps and as_long

    def seal(self) -> bytes:
        """The checksum of all fields but the last use."""
        values = [
            self.id,
            self.name,
            self.role,
            None if self.maps is None else sorted(self.maps),
            self.digest.hex(),
            *(text_of(moment) for moment in (self.created_at, self.expires_at, self.revoked_at)),
        ]
        return hashlib.sha256(json.dumps(values).encode()).digest()


def digest_of(token: bytes) -> bytes:
    """The SHA-256 of a key, which is all that is stored of its secret."""
    return hashlib.sha256(token).digest()


class KeyNarrowing(Protocol):
    """All keys, while nobody else changes them; changes are committed when the block ends without an error."""

    def read(self) -> list[Key]: ...
    def put(self, key: Key) -> None: ...


class KeyWatch(Protocol):
    """Tells a running service whether keys have changed.  Both reading methods may raise KeysUnreadable."""

    def has_changed(self, demanded: bool) -> bool:
        """Whether the keys have changed since they were read.

        Args:
            demanded: whether there were any.
        """

    def read(self) -> list[Key] | None:
        """Every key; None if none was ever created."""

    def close(self) -> None:
        """Forget what was read."""


class KeyRecords(ABC):
    """The stored keys; any number of processes may use them.

    All methods may raise KeysUnreadable: the keys are damaged, of a later version or writable by others, or the disk or
    server failed.

    remote: whether they are on a server, which may be away for a while.
    """

    remote: ClassVar[bool] = False

    @abstractmethod
    def exists(self) -> bool:
        """Whether keys are needed, because one was ever created."""

    @abstractmethod
    def all(self) -> list[Key]:
        """Every key that was ever created, the oldest first."""

    @abstractmethod
    def note_uses(self, moments: dict[str, datetime]) -> None:
        """Store when keys were last used; an earlier time never replaces a later one."""

    @abstractmethod
    def watch(self) -> KeyWatch:
        """The watch by which a running service learns of changes."""

    @abstractmethod
    def changing(self) -> AbstractContextManager[KeyNarrowing]:
        """A change, which is durable when the context ends."""

    @abstractmethod
    def _prepare(self) -> None:
        """Make room for the first key."""

    def create(
        self,
        name: str,
        role: Role,
        maps: Iterable[str] | None = None,
        expires_at: datetime | None = None,
        keep_admin: bool = False,
    ) -> tuple[Key, str]:
        """Create a key; return it and its text, which is not stored.  It is on disk when this returns.

        Args:
            keep_admin: refuse a first key that cannot manage the service.

        Raises:
            InvalidRequest: the name, the role or the expiry cannot be used.
            KeyExists: another key in force has the name.
            InvalidIdentifier: the id of a map is not valid.
            TooManyKeys, LastAdminKey.
        """
        if not NAME.fullmatch(name) or ID.fullmatch(name) or name in RESERVED:
            raise InvalidRequest(
                f"A key cannot have the name {name[:80]!r}. Use at most 64 letters, digits and . _ @ -."
            )
        if LEVELS.get(role, 0) < 1:
            raise InvalidRequest(f"{role!r} is not a role. Use query, enrol or admin.")
        limits = None if maps is None else frozenset(check_map_id(map_id) for map_id in maps)
        now = datetime.now(UTC)
        if expires_at is not None and expires_at <= now:
            raise InvalidRequest("The expiry of the key is in the past.")
        identity = secrets.token_hex(6)
        token = f"placerec_{identity}_{secrets.token_urlsafe(SECRET_BYTES)}"
        key = Key(identity, name, role, limits, digest_of(token.encode()), now, expires_at)
        if not self.exists():
            if keep_admin:
                _check_admin([key], now)  # before there is a file, with which keys are needed
            self._prepare()
        with self.changing() as changes:
            keys = changes.read()
            if any(other.name == name and in_force(other, now) for other in keys):
                raise KeyExists(f"There is already a key {name!r}. Delete it first, or choose another name.")
            if len(keys) >= MOST_KEYS:
                raise TooManyKeys(f"{MOST_KEYS} keys were created, which is the most that one data directory holds.")
            if keep_admin:
                _check_admin([*keys, key], now)
            changes.put(key)
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
            changes: new values of ``role``, ``maps`` and ``expires_at``; fields that are left out stay.
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
        with self.changing() as changing:
            keys = changing.read()
            before = _of_id(keys, key_id)
            if not in_force(before, now):
                raise KeyEnded(f"The key {before.name!r} is revoked or has expired; create another one.")
            after = replace(before, **changes)
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
            changing.put(after)
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
        with self.changing() as changes:
            keys = changes.read()
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
            changes.put(key)
        return key


@dataclass(frozen=True)
class _FileChanges:
    """A change of a file of keys."""

    connection: sqlite3.Connection

    def read(self) -> list[Key]:
        return read_keys(self.connection)

    def put(self, key: Key) -> None:
        marks = ", ".join("?" * len(COLUMNS))
        self.connection.execute(f"INSERT OR REPLACE INTO keys ({', '.join(COLUMNS)}) VALUES ({marks})", row_of(key))


class KeyStore(KeyRecords):
    """The keys of a data directory.  Each method opens the file anew."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE

    def exists(self) -> bool:
        try:
            self.path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise KeysUnreadable(f"{self.path} cannot be looked at: {error.strerror}.") from error
        return True

    def all(self) -> list[Key]:
        if not self.exists():
            return []
        with closing(self.open()) as connection, _refusals(self.path):
            return read_keys(connection)

    def watch(self) -> KeyWatch:
        return KeyFileWatch(self)

    def note_uses(self, moments: dict[str, datetime]) -> None:
        with self._transaction() as connection:
            connection.executemany(
                "UPDATE keys SET last_used_at = max(coalesce(last_used_at, ''), ?) WHERE id = ?",
                [(text_of(moment), identity) for identity, moment in moments.items()],
            )

    def open(self) -> sqlite3.Connection:
        """Open a connection to the file, after checking that it is intact and a file of keys."""
        with _refusals(self.path):
            status = self.path.stat()
            if not stat.S_ISREG(status.st_mode) or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                raise KeysUnreadable(f"Others may write to {self.path}: chmod 600 it, then look whose keys it holds.")
            try:
                return SqliteFile(self.path, _SCHEMA, {}, timeout=BUSY_SECONDS).open(create=False)
            except UnreadVersion as error:
                raise KeysUnreadable(str(error.refusal(str(self.path)))) from error
            except NotOurs as error:
                raise KeysUnreadable(
                    f"{self.path} is not a file of keys, or it is damaged; nobody is let in. Restore it."
                ) from error
            except Damage as error:
                raise KeysUnreadable(f"{self.path} is damaged: {error}.") from error

    @contextmanager
    def changing(self) -> Iterator[KeyNarrowing]:
        with self._transaction() as connection:
            yield _FileChanges(connection)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """A connection in a transaction, which is on disk when the context ends."""
        with closing(self.open()) as connection, _refusals(self.path):
            # A rollback journal: the file is all there is of the keys.  EXTRA syncs the folder too, or a power
            # cut could bring the journal back, and with it a key that was revoked.
            connection.execute("PRAGMA synchronous = EXTRA")
            with transaction(connection):
                yield connection

    def _prepare(self) -> None:
        """Make the file whole or not at all: one without its tables would count as damaged."""
        temporary = self.path.with_name(f"{FILE}.{secrets.token_hex(4)}.tmp")
        with _refusals(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, MODE))
                with closing(connect(temporary, "rw", {"synchronous": "EXTRA"})) as connection:
                    _SCHEMA.prepare(connection, create=True)
                with suppress(FileExistsError):  # another process was quicker
                    os.link(temporary, self.path)
                sync_folder(self.path.parent)
            finally:
                with suppress(FileNotFoundError):
                    temporary.unlink()


@dataclass(frozen=True)
class _File:
    """The file as it was last read: its connection, its attributes in the file system, SQLite's count of changes."""

    connection: sqlite3.Connection
    traits: tuple[int, ...]
    changes: int


class KeyFileWatch:
    """Tells whether a file of keys has changed, without reading it."""

    def __init__(self, store: KeyStore) -> None:
        self._store = store
        self._file: _File | None = None

    def has_changed(self, demanded: bool) -> bool:
        file, path = self._file, self._store.path
        try:
            status = os.stat(path)
        except FileNotFoundError:
            if demanded:
                raise KeysUnreadable(f"{path} is gone.") from None
            return False
        except OSError as error:
            raise KeysUnreadable(f"{path} cannot be looked at: {error.strerror}.") from error
        if file is None or file.traits != _traits(status):
            return True
        try:
            return _changes(file.connection) != file.changes
        except sqlite3.Error as error:
            raise KeysUnreadable(f"{path} cannot be read: {error}.") from error

    def read(self) -> list[Key] | None:
        if not self._store.exists():
            return None
        self.close()
        connection = self._store.open()
        try:
            status = os.stat(self._store.path)
            changes = _changes(connection)
            keys = read_keys(connection)
        except (OSError, sqlite3.Error) as error:
            connection.close()
            raise KeysUnreadable(f"{self._store.path} cannot be read: {error}.") from error
        except BaseException:
            connection.close()
            raise
        self._file = _File(connection, _traits(status), changes)
        return keys

    def close(self) -> None:
        if self._file is not None:
            self._file.connection.close()
            self._file = None


def _traits(status: os.stat_result) -> tuple[int, ...]:
    """Attributes that change when a file is replaced, or written to without SQLite."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_mode


def _changes(connection: sqlite3.Connection) -> int:
    """A number that changes when another connection changes the file."""
    (found,) = connection.execute("PRAGMA data_version").fetchone()
    return int(found)


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
            "could create one. Create such a key first, or send ?lock_out=true."
        )


def _of_id(keys: Iterable[Key], key_id: str) -> Key:
    for key in keys:
        if key.id == key_id:
            return key
    raise _unknown(key_id)


def _unknown(id_or_name: str) -> UnknownKey:
    return UnknownKey(f"There is no such key ({id_or_name[:80]!r}).")


def read_keys(connection: sqlite3.Connection) -> list[Key]:
    """Every key of an open file, the oldest first.

    Raises:
        KeysUnreadable: a row is damaged.
    """
    query = f"SELECT {', '.join(COLUMNS)} FROM keys ORDER BY created_at, id"
    return [key_of(row) for row in connection.execute(query).fetchall()]


def key_of(row: tuple[object, ...]) -> Key:
    """The key of a stored row, whose columns are ``COLUMNS``.

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


def row_of(key: Key) -> tuple[object, ...]:
    """A key as it is stored."""
    return (
        key.id,
        key.name,
        key.role,
        None if key.maps is None else json.dumps(sorted(key.maps)),
        key.digest,
        text_of(key.created_at),
        text_of(key.expires_at),
        text_of(key.revoked_at),
        key.seal(),
        text_of(key.last_used_at),
    )


def _key(row: tuple[object, ...]) -> Key:
    identity, name, role, maps, digest, created, expires, revoked, _, used = row
    if role not in LEVELS or not isinstance(digest, bytes):
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
    )


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        raise KeysUnreadable(f"{path} cannot be used: {error}.") from error


def text_of(moment: datetime | None) -> str | None:
    return None if moment is None else moment.astimezone(UTC).isoformat(timespec="microseconds")
