"""Frames that a map stores because its answers were doubtful, and people's labels of them.

A frame is stored whole or not at all.  The frames of a map are bounded by its setting: the oldest frame without a label
goes first, then the oldest with one.  Frames have their SHA-256, and their rows a checksum.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    CheckConstraint,
    Column,
    MetaData,
    PrimaryKeyConstraint,
    Table,
    UniqueConstraint,
    bindparam,
    delete,
    func,
    select,
    update,
)

from core.errors import StorageFailure, UnknownFrame
from core.ledger.maps.checksums import is_sound, sealed, sealed_columns
from core.ledger.maps.connection import MapConnection
from core.ledger.statements import Statement, among, binary, integer, text
from core.maps.records import ReviewSetting
from core.maps.review import ReviewFrame, StoredReviews, frames_to_drop
from core.maps.stored_fields import moment_text

METADATA = MetaData()

FRAMES = Table(
    "review_frames", METADATA, Column("map", integer(), nullable=False), Column("number", integer(), nullable=False),
    Column("at", text(), nullable=False), Column("digest", binary(), nullable=False),
    Column("size", integer(), nullable=False), Column("answer", text(), nullable=False), Column("label", text()),
    Column("object", text()),  # always NULL; the checksums of rows of 1.0 cover it
    Column("seal", integer(), nullable=False), PrimaryKeyConstraint("map", "number"),
    UniqueConstraint("map", "digest"), CheckConstraint("length(digest) = 32"), sqlite_strict=True,
)  # fmt: skip
# Apart from the frames, so that a listing need not read the pictures.
_PICTURES = Table(
    "review_pictures", METADATA, Column("map", integer(), nullable=False), Column("number", integer(), nullable=False),
    Column("bytes", binary(), nullable=False), PrimaryKeyConstraint("map", "number"), sqlite_strict=True,
)  # fmt: skip
# The number of the next frame, so that none is used twice.
_NUMBERS = Table(
    "review_numbers", METADATA, Column("map", integer(), primary_key=True), Column("next", integer(), nullable=False),
    sqlite_strict=True,
)  # fmt: skip

_F, _P = FRAMES.c, _PICTURES.c
_COLUMNS = sealed_columns(FRAMES)
_OF_MAP = _F.map == bindparam("map")
_READ = select(*(_F[name] for name in _COLUMNS), _F.seal).where(_OF_MAP)
_PAGE = _READ.where(_F.number < bindparam("before")).order_by(_F.number.desc()).limit(bindparam("most"))
_PAGES = {
    None: Statement(_PAGE),
    True: Statement(_PAGE.where(_F.label.is_not(None))),
    False: Statement(_PAGE.where(_F.label.is_(None))),
}
_LABELLED = Statement(_READ.where(_F.label.is_not(None)).order_by(_F.number))
_LABEL_SEALS = Statement(select(_F.number, _F.seal).where(_OF_MAP, _F.label.is_not(None)).order_by(_F.number))
_ALL = Statement(_READ.order_by(_F.number))
_FIND = Statement(_READ.where(_F.number == bindparam("number")))
_SIZE = Statement(select(func.count(), func.coalesce(func.sum(_F.size), 0)).where(_OF_MAP))
_BY_AGE = Statement(select(_F.number, _F.size).where(_OF_MAP).order_by(_F.label.is_not(None), _F.number))
_BEFORE = Statement(select(_F.number).where(_OF_MAP, _F.at < bindparam("moment")))
_PUT = Statement(
    lambda insert: (
        insert(FRAMES)
        .values({name: bindparam(name) for name in ("map", *_COLUMNS, "seal")})
        .on_conflict_do_nothing()
        .returning(_F.number)
    )
)
_LABEL = Statement(
    update(FRAMES)
    .where(_OF_MAP, _F.number == bindparam("which"))
    .values(label=bindparam("new_label"), seal=bindparam("new_seal"))
)
_LABEL_FIRST = Statement(
    update(FRAMES)
    .where(_OF_MAP, _F.number == bindparam("which"), _F.label.is_(None))
    .values(label=bindparam("new_label"), seal=bindparam("new_seal"))
)
_BY_DIGEST = Statement(_READ.where(_F.digest == bindparam("digest")))
_RENEW = Statement(
    update(FRAMES)
    .where(_OF_MAP, _F.number == bindparam("which"))
    .values(answer=bindparam("new_answer"), seal=bindparam("new_seal"))
)
_DELETE = Statement(delete(FRAMES).where(_OF_MAP, among(_F.number, "numbers")))
_DELETE_PICTURES = Statement(delete(_PICTURES).where(_P.map == bindparam("map"), among(_P.number, "numbers")))
_PUT_PICTURE = Statement(
    lambda insert: insert(_PICTURES).values({name: bindparam(name) for name in ("map", "number", "bytes")})
)
_PICTURE = Statement(select(_P.bytes).where(_P.map == bindparam("map"), _P.number == bindparam("number")))
_FIRST_AFTER = Statement(
    select(_F.number, _F.digest, _P.bytes)
    .outerjoin(_PICTURES, (_P.map == _F.map) & (_P.number == _F.number))
    .where(_OF_MAP, _F.number > bindparam("after"))
    .order_by(_F.number)
    .limit(1)
)
_NEXT = Statement(
    lambda insert: (
        insert(_NUMBERS)
        .values(map=bindparam("map"), next=2)
        .on_conflict_do_update(index_elements=["map"], set_={"next": _NUMBERS.c.next + 1})
        .returning(_NUMBERS.c.next - 1)
    )
)


class ReviewTable(ABC):
    """The frames of one map that are stored for review (:class:`core.maps.review.Review`).  Any thread may use it."""

    def __init__(self) -> None:
        self._held: set[int] = set()

    @abstractmethod
    def _reading(self) -> AbstractContextManager[MapConnection]:
        """A transaction that reads, and raises if the map is gone."""

    @abstractmethod
    def _writing(self) -> AbstractContextManager[MapConnection]:
        """A transaction that writes, and raises if the map is gone."""

    def keep(self, data: bytes, answer: Mapping[str, Any], setting: ReviewSetting, renew: bool = False) -> bool:
        if len(data) > setting.most_bytes:
            return False
        digest = hashlib.sha256(data).digest()
        with self._writing() as connection:
            if renew and (known := connection.one(_BY_DIGEST, digest=digest)) is not None:
                return _renewed(connection, known, answer)
            if not self._insert(connection, data, datetime.now(UTC), answer, None):
                return False
            self._drop_oldest(connection, setting)
        return True

    def restore(self, data: bytes, at: datetime, answer: Mapping[str, Any], label: Mapping[str, Any]) -> bool:
        """Store a labelled frame of an export file, under a new number, whatever the limits; False if it is there."""
        with self._writing() as connection:
            return self._insert(connection, data, at, answer, label)

    def _insert(
        self,
        connection: MapConnection,
        data: bytes,
        at: datetime,
        answer: Mapping[str, Any],
        label: Mapping[str, Any] | None,
    ) -> bool:
        """Store a frame under the next number, unless the same file is stored already; whether it was."""
        ((number,),) = connection.execute(_NEXT)
        values = {
            "number": number,
            "at": moment_text(at),
            "digest": hashlib.sha256(data).digest(),
            "size": len(data),
            "answer": json.dumps(answer),
            "label": None if label is None else json.dumps(label),
            "object": None,
        }
        if not connection.execute(_PUT, **sealed(_COLUMNS, values)):
            return False
        connection.execute(_PUT_PICTURE, number=number, bytes=data)
        return True

    def labels_state(self) -> object:
        """A value that is the same as long as no frame gets or loses a label."""
        with self._reading() as connection:
            return tuple(connection.execute(_LABEL_SEALS))

    def shrink(self, setting: ReviewSetting) -> None:
        with self._writing() as connection:
            self._drop_oldest(connection, setting)

    def _drop_oldest(self, connection: MapConnection, setting: ReviewSetting) -> None:
        """Drop frames, those without a label first and the oldest of these first, until the limits hold.

        Those that are held stay.
        """
        count, size = _size(connection)
        if not setting.allows(count, size):
            by_age = ((int(number), int(length)) for number, length in connection.execute(_BY_AGE))
            drop(connection, frames_to_drop(by_age, count, size, setting, self._held))

    def drop_before(self, moment: datetime) -> int:
        with self._writing() as connection:
            return self._drop_before(connection, moment)

    def _drop_before(self, connection: MapConnection, moment: datetime) -> int:
        old = [int(number) for (number,) in connection.execute(_BEFORE, moment=moment_text(moment))]
        if going := [number for number in old if number not in self._held]:
            drop(connection, going)
        return len(going)

    def page(self, before: int | None, limit: int, labelled: bool | None = None) -> StoredReviews:
        with self._reading() as connection:
            found = connection.execute(_PAGES[labelled], before=2**62 if before is None else before, most=limit)
            return StoredReviews([_frame(values) for values in found], *_size(connection))

    def labelled(self) -> list[ReviewFrame]:
        with self._reading() as connection:
            return [_frame(values) for values in connection.execute(_LABELLED)]

    def find(self, number: int) -> ReviewFrame:
        with self._reading() as connection:
            return _frame(_expect(connection, number))

    def picture(self, number: int) -> bytes:
        with self._reading() as connection:
            frame, stored = _frame(_expect(connection, number)), connection.one(_PICTURE, number=number)
        if stored is None or hashlib.sha256(stored[0]).digest() != frame.digest:
            raise StorageFailure(f"The picture of the frame {number} is damaged; discard the frame.")
        return bytes(stored[0])

    @contextmanager
    def held(self, number: int) -> Iterator[None]:
        """Have this service not drop a frame for newer ones until the block ends; another service may."""
        self._held.add(number)
        try:
            yield
        finally:
            self._held.discard(number)

    def label(self, number: int, label: Mapping[str, Any] | None) -> ReviewFrame:
        with self._writing() as connection:
            values = _expect(connection, number)
            if not _labelled(connection, _LABEL, values, label):
                raise _unknown(number)
        before = _frame(values)
        return replace(before, label=label, replaced=before.label)

    def label_first(self, number: int, label: Mapping[str, Any]) -> bool:
        with self._writing() as connection:
            return _labelled(connection, _LABEL_FIRST, _expect(connection, number), label)

    def discard(self, number: int) -> None:
        with self._writing() as connection:
            _expect(connection, number)
            drop(connection, [number])


def _labelled(
    connection: MapConnection, statement: Statement, values: tuple[Any, ...], label: Mapping[str, Any] | None
) -> bool:
    """Give a stored frame a label, or none; whether the statement allows it."""
    *stored, _ = values
    after = {**dict(zip(_COLUMNS, stored, strict=True)), "label": None if label is None else json.dumps(label)}
    changed = sealed(_COLUMNS, after)
    number = after["number"]
    return bool(connection.change(statement, which=number, new_label=changed["label"], new_seal=changed["seal"]))


def _renewed(connection: MapConnection, known: tuple[Any, ...], answer: Mapping[str, Any]) -> bool:
    """Give a stored frame another answer, unless it has a label; whether it got it."""
    *columns, _ = known
    before = dict(zip(_COLUMNS, columns, strict=True))
    changed = sealed(_COLUMNS, {**before, "answer": json.dumps(answer)})
    values = {"which": before["number"], "new_answer": changed["answer"], "new_seal": changed["seal"]}
    return before["label"] is None and bool(connection.change(_RENEW, **values))


def drop(connection: MapConnection, numbers: list[int]) -> None:
    """Delete frames with their pictures."""
    connection.execute(_DELETE_PICTURES, numbers=numbers)
    connection.execute(_DELETE, numbers=numbers)


def unsound(connection: MapConnection) -> list[int]:
    """The numbers of the frames whose row does not match its checksum."""
    return [int(columns[0]) for *columns, seal in connection.execute(_ALL) if not is_sound(columns, seal)]


def first_after(connection: MapConnection, number: int) -> tuple[int, bytes, bytes | None] | None:
    """The first frame of a higher number: its number, its digest, and its picture, unless that is gone."""
    found = connection.one(_FIRST_AFTER, after=number)
    return None if found is None else (int(found[0]), found[1], found[2])


def _size(connection: MapConnection) -> tuple[int, int]:
    """How many frames are stored, and their bytes."""
    ((count, size),) = connection.execute(_SIZE)
    return int(count), int(size)


def _expect(connection: MapConnection, number: int) -> tuple[Any, ...]:
    values = connection.one(_FIND, number=number)
    if values is None:
        raise _unknown(number)
    return values


def _unknown(number: int) -> UnknownFrame:
    return UnknownFrame(f"The map keeps no frame {number} for review.")


def _frame(values: tuple[Any, ...]) -> ReviewFrame:
    number, at, digest, size, answer, label, *_ = values
    said = None if label is None else json.loads(label)
    return ReviewFrame(number, datetime.fromisoformat(at), digest, size, json.loads(answer), said)
