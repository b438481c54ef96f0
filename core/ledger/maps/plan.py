"""A plan of a map: where all its places are, as columns of JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from sqlalchemy import bindparam, case, func, select

from core.ledger.maps.connection import Reading
from core.ledger.maps.schema import PLACES, SEQUENCES
from core.ledger.statements import Statement, json_list, rounded

HANDED_OVER, HAS_PICTURE = 1, 2
"""Flags of a place in a plan: its pose is that of another place; a picture of its frame is stored."""

_P, _S = PLACES.c, SEQUENCES.c
_DIGITS = {"x": 3, "y": 3, "z": 3, "latitude": 7, "longitude": 7, "heading": 2}
"""Metres to the millimetre, degrees of position to a centimetre on the ground."""

_NAMES = Statement(select(_S.code, _S.name).where(_S.map == bindparam("map"), _S.name.is_not(None)).order_by(_S.name))
_LISTED = (
    select(
        _P.id,
        _P.sequence,
        *(rounded(_P[name], digits).label(name) for name, digits in _DIGITS.items()),
        func.substr(_P.timestamp, 1, 26).label("timestamp"),
        (
            case((_P.pose_of.is_not(None), HANDED_OVER), else_=0) + case((_P.picture != "none", HAS_PICTURE), else_=0)
        ).label("flags"),
    )
    .where(_P.map == bindparam("map"), _P.look_of.is_(None), (_P.number - 1) % bindparam("step") == 0)
    .order_by(_P.number)
    .subquery()
    .c
)
_OPTIONAL = (*_DIGITS, "timestamp")
# As JSON of the database: an object for each value of each place takes far longer.
_PLACES = Statement(
    select(
        json_list(_LISTED.id), json_list(_LISTED.sequence), json_list(_LISTED.flags),
        *(func.count(_LISTED[name]) for name in _OPTIONAL), *(json_list(_LISTED[name]) for name in _OPTIONAL),
    )
)  # fmt: skip


class Plan:
    """Reads the plan of one map: where all its places are.  Any thread may use it.

    Args:
        reading: begins a transaction that reads the map; the method may raise what it raises.
    """

    def __init__(self, reading: Reading) -> None:
        self._reading = reading

    def columns(self, step: int = 1) -> str:
        """The places in the order of their enrolment as the members of a JSON object, without its braces.

        The members: ``sequences``, the names of the traverses; arrays with a value for each place: ``ids``,
        ``sequence`` (index into ``sequences``, -1 without one) and ``flags`` (:data:`HANDED_OVER`,
        :data:`HAS_PICTURE`); and ``x``, ``y``, ``z`` (metres), ``latitude``, ``longitude``, ``heading`` (degrees) and
        ``timestamp`` (milliseconds since 1970 UTC), each an array with null where a place has no value, or null if no
        place has one.

        Args:
            step: about one place in every ``step`` is listed.
        """
        with self._reading() as connection:
            names = dict(connection.execute(_NAMES))
            ((ids, sequence, flags, *optional),) = connection.execute(_PLACES, step=step)
        counts, values = optional[: len(_OPTIONAL)], optional[len(_OPTIONAL) :]
        position = {code: at for at, code in enumerate(names)}
        columns = {
            "sequences": _text(list(names.values())),
            "ids": ids,
            "sequence": _text([position.get(code, -1) for code in json.loads(sequence)]),
        }
        columns |= {
            name: column if count else "null" for name, count, column in zip(_OPTIONAL, counts, values, strict=True)
        }
        columns |= {"timestamp": _milliseconds(columns["timestamp"]), "flags": flags}
        return ",".join(f'"{name}":{column}' for name, column in columns.items())


def _milliseconds(moments: str) -> str:
    """A list of moments, or null, in JSON as milliseconds since 1970 UTC."""
    texts = json.loads(moments)
    if texts is None:
        return moments
    found = (np.array(texts, "datetime64[us]").astype(np.int64) / 1000).round().astype(np.int64).tolist()
    return _text([None if text is None else moment for text, moment in zip(texts, found, strict=True)])


def _text(values: Sequence[str | int | None]) -> str:
    return json.dumps(values, separators=(",", ":"))
