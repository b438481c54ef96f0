"""Frames that a map stores because its answers were doubtful, and people's labels of them.

A frame is stored whole or not at all.  The frames of a map are bounded by its setting: the oldest frame without a label
goes first, then the oldest with one.  Frames have their SHA-256, and their rows a checksum.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import bindparam, delete, func, select, update

from core.errors import StorageFailure, UnknownFrame
from core.ledger.maps.checksums import is_sound, sealed, sealed_columns
from core.ledger.maps.connection import MapConnection, Reading
from core.ledger.maps.schema import REVIEW_FRAMES as FRAMES
from core.ledger.maps.schema import REVIEW_NUMBERS as NUMBERS
from core.ledger.maps.schema import REVIEW_PICTURES as PICTURES
from core.ledger.statements import Statement, among
from core.maps.records import ReviewSetting
from core.maps.review import ReviewFrame, StoredReviews, frames_to_drop
from core.maps.stored_fields import moment_text

_F, _P = FRAMES.c, PICTURES.c
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
_DELETE_PICTURES = Statement(delete(PICTURES).where(_P.map == bindparam("map"), among(_P.number, "numbers")))
_PUT_PICTURE = Statement(
    lambda insert: insert(PICTURES).values({name: bindparam(name) for name in ("map", "number", "bytes")})
)
_PICTURE = Statement(select(_P.bytes).where(_P.map == bindparam("map"), _P.number == bindparam("number")))
_FIRST_AFTER = Statement(
    select(_F.number, _F.digest, _P.bytes)
    .outerjoin(PICTURES, (_P.map == _F.map) & (_P.number == _F.number))
    .where(_OF_MAP, _F.number > bindparam("after"))
    .order_by(_F.number)
    .limit(1)
)
_NEXT = Statement(
    lambda insert: (
        insert(NUMBERS)
        .values(map=bindparam("map"), next=2)
        .on_conflict_do_update(index_elements=["map"], set_={"next": NUMBERS.c.next + 1})
        .returning(NUMBERS.c.next - 1)
    )
)


class Review:
    """The frames of one map that are stored for review.  Any thread may use it.

    They are not part of what a search needs, so the revision of the map does not count them.  Every method may raise
    what ``reading`` and ``writing`` raise.

    Args:
        reading: begins a transaction that reads the map.
        writing: begins one that writes, in which nobody else writes to the map.
    """

    def __init__(self, reading: Reading, writing: Reading) -> None:
        self._reading, self._writing = reading, writing
        self._held: set[int] = set()

    def keep(self, data: bytes, answer: Mapping[str, Any], setting: ReviewSetting, renew: bool = False) -> bool:
        """Keep a frame, and drop the oldest ones beyond the limits; it is durable when this returns.

        Args:
            renew: if the same file is stored already, and has no label, it gets this answer in place of its former one.

        Returns:
            Whether it was stored: not if the same file is stored already, or is larger than all frames may be together.
        """
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
        """Drop the oldest frames beyond new limits, and give back the room."""
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
        """Drop the frames that were asked before a moment, with their labels; returns how many."""
        with self._reading() as connection:
            if not connection.execute(_BEFORE, moment=moment_text(moment)):
                return 0
        with self._writing() as connection:
            old = [int(number) for (number,) in connection.execute(_BEFORE, moment=moment_text(moment))]
            if going := [number for number in old if number not in self._held]:
                drop(connection, going)
            return len(going)

    def page(self, before: int | None, limit: int, labelled: bool | None = None) -> StoredReviews:
        """The latest frames, newest first, and how many are stored in all, as of one moment; without damaged ones.

        Args:
            before: only frames with a smaller number; None: all.
            labelled: only frames with a label, or without one; None: all.
        """
        with self._reading() as connection:
            found = connection.execute(_PAGES[labelled], before=2**62 if before is None else before, most=limit)
            return StoredReviews(_frames(found), *_size(connection))

    def labelled(self) -> list[ReviewFrame]:
        """All frames with a label, oldest first; without damaged ones."""
        with self._reading() as connection:
            return _frames(connection.execute(_LABELLED))

    def find(self, number: int) -> ReviewFrame:
        """One frame.

        Raises:
            UnknownFrame: it is not stored.
            StorageFailure: it is damaged.
        """
        with self._reading() as connection:
            return _frame(_expect(connection, number))

    def picture(self, number: int) -> bytes:
        """The file of a frame.

        Raises:
            UnknownFrame: it is not stored.
            StorageFailure: it is damaged.
        """
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
        """Label a frame; the label replaces an earlier one, and None takes it back.

        Raises:
            UnknownFrame: it is not stored.
        """
        with self._writing() as connection:
            values = _expect(connection, number)
            if not _labelled(connection, _LABEL, values, label):
                raise _unknown(number)
        before = _frame(values)
        return replace(before, label=label, replaced=before.label)

    def label_first(self, number: int, label: Mapping[str, Any]) -> bool:
        """Label a frame that has no label, whoever else labels it at the same time; whether it had none.

        Raises:
            UnknownFrame: it is not stored.
        """
        with self._writing() as connection:
            return _labelled(connection, _LABEL_FIRST, _expect(connection, number), label)

    def discard(self, number: int) -> None:
        """Throw a frame away.

        Raises:
            UnknownFrame: it is not stored.
        """
        with self._writing() as connection:
            if connection.one(_FIND, number=number) is None:
                raise _unknown(number)
            drop(connection, [number])


PAGE = 500
"""Frames that are read at a time."""


def stored_frames(
    review: Review, labelled: bool | None = None, look: Callable[[], None] = lambda: None
) -> Iterator[ReviewFrame]:
    """All frames that a map has stored for review, the newest first; those that are read may be discarded meanwhile.

    Args:
        labelled: only frames with a label, or without one; None: all.
        look: is called before each page.
    """
    before: int | None = None
    while True:
        look()
        if not (page := review.page(before, PAGE, labelled).frames):
            return
        yield from page
        before = page[-1].number


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
    before = dict(zip(_COLUMNS, _checked(known)[:-1], strict=True))
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
    return _checked(values)


def _checked(values: tuple[Any, ...]) -> tuple[Any, ...]:
    *columns, seal = values
    if not is_sound(columns, seal):
        raise StorageFailure(f"The frame {columns[0]} is damaged; discard the frame.")
    return values


def _frames(found: list[tuple[Any, ...]]) -> list[ReviewFrame]:
    return [_frame(values) for values in found if is_sound(values[:-1], values[-1])]


def _unknown(number: int) -> UnknownFrame:
    return UnknownFrame(f"The map keeps no frame {number} for review.")


def _frame(values: tuple[Any, ...]) -> ReviewFrame:
    number, at, digest, size, answer, label, *_ = values
    said = None if label is None else json.loads(label)
    return ReviewFrame(number, datetime.fromisoformat(at), digest, size, json.loads(answer), said)
