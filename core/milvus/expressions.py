"""Conditions on places as boolean expressions of Milvus.

An expression may hold of more places than its condition does (the square around a disc stands for it), never of
fewer: whoever searches compares what was found with the condition itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from core.judgement.priors import TOLERANCE, Constraint, Disc, Facing, GeographicBox, InSequences, NotLately, Period
from core.places import EARTH_RADIUS, GEOGRAPHIC, METRIC, NO_TIME

NO_HEADING = -1.0
"""The value in Milvus for the heading of a place without one."""

_MARGIN = 1e-3  # metres and degrees by which bounds are widened, because positions were rounded


def all_of(expressions: Iterable[str]) -> str:
    """The expression that holds where all of several do."""
    return " and ".join(f"({one})" for one in expressions)


def any_row(rows: Sequence[int]) -> str:
    """One of these rows."""
    return f"row in {[int(row) for row in rows]}"


def with_tokens(tokens: Sequence[str]) -> list[str]:
    """Each of these values of metadata."""
    return [f'json_contains(metadata["tokens"], "{token}")' for token in tokens]


def bounds_of(constraint: Constraint) -> str | None:
    """An expression that holds wherever a constraint does; None if there is none but the one that always holds."""
    match constraint:
        case Disc():
            return _disc(constraint)
        case GeographicBox():
            south, north = (EARTH_RADIUS * np.sin(np.radians(edge)) for edge in (constraint.south, constraint.north))
            return f"kind == {GEOGRAPHIC} and {_between('z', south - TOLERANCE, north + TOLERANCE)}"
        case Facing(heading, tolerance):
            turned = [heading % 360 + turn for turn in (-360, 0, 360)]
            ranges = " or ".join(f"({_between('heading', at - tolerance, at + tolerance)})" for at in turned)
            return f"heading > {NO_HEADING / 2} and ({ranges})"
        case Period(after, before):
            found = [f"timestamp > {NO_TIME + 1}"]
            found += [] if after is None else [f"timestamp >= {after}"]
            found += [] if before is None else [f"timestamp <= {before}"]
            return all_of(found)
        case InSequences(codes):
            return f"sequence in {list(codes)}"
        case NotLately(sequence, ordinal, None, _) if ordinal is not None:
            return f"sequence != {sequence} or ordinal < {ordinal}"
    return None


def _between(field: str, low: float, high: float) -> str:
    return f"{field} >= {float(low - _MARGIN)!r} and {field} <= {float(high + _MARGIN)!r}"


def _disc(disc: Disc) -> str:
    metric = disc.centre.kind() == "metric"
    axes = "xy" if metric and disc.centre.z is None else "xyz"
    centre = disc.centre.position().tolist()
    within = [_between(axis, at - disc.radius, at + disc.radius) for axis, at in zip(axes, centre, strict=False)]
    return all_of([f"kind == {METRIC if metric else GEOGRAPHIC}", *within])
