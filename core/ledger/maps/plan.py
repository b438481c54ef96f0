"""A plan of a map: where all its places are, as columns of JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from sqlalchemy import and_, bindparam, func, select

from core.ledger.maps.connection import Reading
from core.ledger.maps.schema import PLACES, SEQUENCES
from core.ledger.statements import Statement
from core.maps.store import HANDED_OVER, HAS_PICTURE

_P, _S = PLACES.c, SEQUENCES.c
_DIGITS = {"x": 3, "y": 3, "z": 3, "latitude": 7, "longitude": 7, "heading": 2}
"""Metres to the millimetre, degrees of position to a centimetre on the ground."""

_PLACES = Statement(
    select(_P.id, _S.name, *(_P[name] for name in _DIGITS), func.substr(_P.timestamp, 1, 26), _P.pose_of, _P.picture)
    .join(SEQUENCES, and_(_S.map == _P.map, _S.code == _P.sequence))
    .where(_P.map == bindparam("map"), (_P.number - 1) % bindparam("step") == 0)
    .order_by(_P.number)
)
_NAMES = Statement(select(_S.name).where(_S.map == bindparam("map"), _S.name.is_not(None)).order_by(_S.name))


class Plan:
    """Reads the plan of one map (:class:`core.maps.store.Plan`).  Any thread may use it.

    Args:
        reading: begins a transaction that reads the map; the method may raise what it raises.
    """

    def __init__(self, reading: Reading) -> None:
        self._reading = reading

    def columns(self, step: int = 1) -> str:
        """The places in the order of their enrolment as the members of a JSON object, without its braces."""
        with self._reading() as connection:
            names = [name for (name,) in connection.execute(_NAMES)]
            found = connection.execute(_PLACES, step=step)
        ids, sequences, *poses, moments, sources, pictures = zip(*found, strict=True) if found else ((),) * 11
        position = {name: at for at, name in enumerate(names)}
        columns: dict[str, Any] = {
            "sequences": names,
            "ids": ids,
            "sequence": [position.get(name, -1) for name in sequences],
        }
        for (name, digits), values in zip(_DIGITS.items(), poses, strict=True):
            columns[name] = _or_none([None if value is None else round(value, digits) for value in values])
        milliseconds = (np.array(moments, "datetime64[us]").astype(np.int64) / 1000).round().astype(np.int64).tolist()
        columns["timestamp"] = _or_none(
            [None if text is None else at for text, at in zip(moments, milliseconds, strict=True)]
        )
        columns["flags"] = [
            (source is not None) * HANDED_OVER + (picture != "none") * HAS_PICTURE
            for source, picture in zip(sources, pictures, strict=True)
        ]
        return ",".join(f'"{name}":{json.dumps(values, separators=(",", ":"))}' for name, values in columns.items())


def _or_none(values: Sequence[float | None]) -> Sequence[float | None] | None:
    return None if all(value is None for value in values) else values
