"""Sequences: the traverses of a map, positions in them, and tracks."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import and_, bindparam, case, delete, exists, func, literal_column, select, update

from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import MAPS, PLACES, SEQUENCES
from core.ledger.statements import Statement, among, greatest
from core.maps.records import SequenceSummary
from core.names import spellings
from core.places import NO_SEQUENCE

_S, _P = SEQUENCES.c, PLACES.c
_OF_MAP = _S.map == bindparam("map")
# Looks are where their places are, and do not count among the frames of a sequence.
_OF_SEQUENCE = and_(_P.map == bindparam("map"), _P.sequence == bindparam("code"), _P.look_of.is_(None))
_AT = and_(_OF_SEQUENCE, _P.ordinal == bindparam("ordinal"))

_CODES = Statement(select(_S.name, _S.code).where(_OF_MAP, among(_S.name, "names")))
_NEW = Statement(
    lambda insert: insert(SEQUENCES).values(map=bindparam("map"), code=bindparam("code"), name=bindparam("name"))
)
_NEW_CODE = Statement(
    update(MAPS).where(MAPS.c.number == bindparam("map")).values(codes=MAPS.c.codes + 1).returning(MAPS.c.codes - 1)
)
_NEXT = Statement(
    update(SEQUENCES)
    .where(_OF_MAP, _S.code == bindparam("which"))
    .values(next_ordinal=_S.next_ordinal + 1, negative=-1 - _S.next_ordinal)
    .returning(_S.next_ordinal - 1)
)
_FREE = greatest(_S.next_ordinal, bindparam("least"))
_KEEP_FREE = Statement(
    update(SEQUENCES).where(_OF_MAP, _S.code == bindparam("which")).values(next_ordinal=_FREE, negative=-_FREE)
)
_DROP = Statement(
    delete(SEQUENCES).where(
        _OF_MAP,
        _S.code == bindparam("which"),
        _S.name.is_not(None),
        ~exists(literal_column("1")).where(_P.map == _S.map, _P.sequence == _S.code),
    )
)
_ENDS = Statement(select(_S.name, _S.next_ordinal).where(_OF_MAP).order_by(_S.name.is_not(None), _S.name))
_SUMMARIES = Statement(
    select(_S.name, func.count(), func.min(_P.timestamp), func.max(_P.timestamp))
    .join(PLACES, and_(_P.map == _S.map, _P.sequence == _S.code, _P.look_of.is_(None)))
    .where(_OF_MAP, _S.name > bindparam("after"))
    .group_by(_S.name)
    .order_by(_S.name)
    .limit(bindparam("most"))
)
_WRONG = Statement(
    select(_S.name)
    .outerjoin(PLACES, and_(_P.map == _S.map, _P.sequence == _S.code))
    .where(_OF_MAP)
    .group_by(_S.map, _S.code, _S.name, _S.next_ordinal)
    .having(
        (func.coalesce(func.max(_P.ordinal), -1) >= _S.next_ordinal)
        | (case((_S.name.is_not(None), 1), else_=0) > func.count(_P.number))
    )
    .limit(bindparam("most"))
)
_LOST = Statement(
    select(_P.id)
    .where(
        _P.map == bindparam("map"),
        ~exists(literal_column("1")).where(_S.map == _P.map, _S.code == _P.sequence),
    )
    .order_by(_P.number)
    .limit(bindparam("most"))
)
_END = Statement(select(_S.next_ordinal).where(_OF_MAP, _S.code == bindparam("code")))
_LAST = Statement(select(_P.ordinal, _P.row).where(_OF_SEQUENCE).order_by(_P.number.desc()).limit(1))
_FIRST_AT = Statement(select(_P.row).where(_AT, _P.number < bindparam("before")).order_by(_P.number).limit(1))
_BEFORE = select(_P.row).where(_AT, _P.number < bindparam("number")).order_by(_P.number.desc()).limit(1)
_LAST_BEFORE = Statement(_BEFORE)
_RENEWED_BEFORE = Statement(_BEFORE.where(_P.row > bindparam("row")))
_FIRST_BEHIND = Statement(select(_P.row).where(_AT, _P.number > bindparam("number")).order_by(_P.number).limit(1))
_ROWS = Statement(
    select(_P.row)
    .join(SEQUENCES, and_(_S.map == _P.map, _S.code == _P.sequence))
    .where(_P.map == bindparam("map"), _S.name == bindparam("name"))
)
_LAST_ORDINALS = select(_P.ordinal).where(_OF_SEQUENCE).order_by(_P.number.desc()).limit(bindparam("frames")).subquery()
_OLDEST_OF_LAST = Statement(select(func.min(_LAST_ORDINALS.c.ordinal)))


def codes_of(connection: MapConnection, names: Sequence[str]) -> dict[str, int]:
    """The codes of sequences (``Whereabouts.sequence``) by name, as it is stored; those that do not exist are left out.

    A name of old may be stored in another form of Unicode, and is found by its one form as well.
    """
    return dict(connection.execute(_CODES, names=[one for name in names for one in spellings(name)]))


def find_code(connection: MapConnection, name: str) -> int | None:
    """The code of a sequence; None if there is none."""
    found = codes_of(connection, [name])
    return next((found[one] for one in spellings(name) if one in found), None)


def new_code(connection: MapConnection) -> int:
    """A code that no sequence or track of the map has, had or will get."""
    ((code,),) = connection.execute(_NEW_CODE)
    return int(code)


def code_of(connection: MapConnection, name: str | None) -> int:
    """The code of a sequence, which is made if there is none; NO_SEQUENCE for None."""
    if name is None:
        return NO_SEQUENCE
    found = find_code(connection, name)
    return new_sequence(connection, name) if found is None else found


def new_sequence(connection: MapConnection, name: str) -> int:
    """Make a sequence without places; returns its code."""
    code = new_code(connection)
    connection.execute(_NEW, code=code, name=name)
    return code


def next_ordinal(connection: MapConnection, code: int) -> int:
    """The ordinal of the next place of a sequence, which counts as taken."""
    ((ordinal,),) = connection.execute(_NEXT, which=code)
    return int(ordinal)


def keep_free(connection: MapConnection, code: int, least: int) -> None:
    """Have the next place of a sequence stand at an ordinal or behind it."""
    connection.execute(_KEEP_FREE, which=code, least=least)


def drop_if_empty(connection: MapConnection, code: int) -> None:
    """Remove a sequence without places; its code is never used again."""
    connection.change(_DROP, which=code)


def ends(connection: MapConnection) -> dict[str | None, int]:
    """The ordinal that the next place of each sequence gets, by name; None: of the places without a sequence."""
    return dict(connection.execute(_ENDS))


def summaries_after(connection: MapConnection, after: str, limit: int) -> list[SequenceSummary]:
    """Up to ``limit`` sequences by name."""
    found = connection.execute(_SUMMARIES, after=after, most=limit)
    return [
        SequenceSummary(name=name, places=places, first_at=first, last_at=last) for name, places, first, last in found
    ]


def wrong(connection: MapConnection, limit: int = 10) -> list[str | None]:
    """The names of some sequences that are empty, or whose next place would not come behind their last."""
    return [name for (name,) in connection.execute(_WRONG, most=limit)]


def lost(connection: MapConnection, limit: int = 10) -> list[str]:
    """The ids of some places whose sequence is missing."""
    return [place_id for (place_id,) in connection.execute(_LOST, most=limit)]


def rows_of(connection: MapConnection, name: str) -> list[int]:
    """The rows of the places of a sequence."""
    return [row for (row,) in connection.execute(_ROWS, name=name)]


def oldest_of_last(connection: MapConnection, code: int, frames: int) -> int | None:
    """The smallest ordinal among the ``frames`` places of a sequence enrolled last; None: it has no places."""
    ((ordinal,),) = connection.execute(_OLDEST_OF_LAST, code=code, frames=frames)
    return None if ordinal is None else int(ordinal)


# Positions


def latest(connection: MapConnection, name: str, positions: int) -> tuple[tuple[int, int] | None, dict[int, int]]:
    """The end of a sequence: ordinal and row of its last place, and the row of the first place at each last ordinal.

    Args:
        positions: the number of ordinals before the last one that are looked at, too.
    """
    code = find_code(connection, name)
    last = None if code is None else connection.one(_LAST, code=code)
    if code is None or last is None:
        return None, {}
    ((following,),) = connection.execute(_END, code=code)
    first = {}
    for ordinal in sorted({last[0], *range(max(0, following - 1 - positions), following)}):
        row = first_at(connection, code, ordinal)
        if row is not None:
            first[int(ordinal)] = row
    return (int(last[0]), int(last[1])), first


def first_at(connection: MapConnection, code: int, ordinal: int, before: int = 1 << 62) -> int | None:
    """The row of the first place at a position of a sequence; None if none is there.

    Args:
        before: only places with a smaller number count.
    """
    found = connection.one(_FIRST_AT, code=code, ordinal=ordinal, before=before)
    return None if found is None else int(found[0])


def beside(connection: MapConnection, code: int, ordinal: int, number: int, row: int) -> list[int]:
    """Rows of places at the position of one that gets another picture (:func:`core.maps.views.leaves_view`)."""
    at = {"code": code, "ordinal": ordinal, "number": number}
    renewed = connection.one(_RENEWED_BEFORE, **at, row=row)
    if renewed is None:
        return []
    found = [renewed, connection.one(_LAST_BEFORE, **at), connection.one(_FIRST_BEHIND, **at)]
    return list({int(one[0]) for one in found if one is not None})
