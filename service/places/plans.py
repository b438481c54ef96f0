"""Plans of maps as they are sent: made one at a time, compressed, and cached until their map is written to."""

from __future__ import annotations

import gzip
import hashlib
import json
import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from anyio import CapacityLimiter

from core.maps import own_poses
from core.places import NO_POSE
from core.recognition.stages import neighborhood_of
from core.store import Map
from core.upkeep import coverage
from core.upkeep.redundancy import first_looks
from service.errors.faults import PlanTooLarge

MOST_PLACES = 200_000
"""Places that one plan lists."""

MOST_BYTES = 64 * 1024 * 1024
"""Bytes of all cached plans together, compressed."""

MOST_GAPS = 500
"""Gaps that a plan lists; all are counted."""

MOST_CACHED = 64
"""Number of cached plans: small ones, such as those of many steps, weigh more than their bytes."""

FAST = 1
"""The level of gzip: a higher one takes longer than a local network saves."""

PlanKey = tuple[str, str, int]
"""The id of a map, the time of its creation, and the step."""


@dataclass(frozen=True)
class MadePlan:
    """A plan.

    state: of the map when it was read (``Map.state``).
    revision: names the content; the same places have the same one.
    compressed: its JSON, by gzip.
    """

    state: object
    revision: str
    compressed: bytes


class Plans:
    """The plans that were requested last.  Any thread may use it."""

    def __init__(self) -> None:
        self.one_at_a_time = CapacityLimiter(1)
        """Limits the threads that make plans, so that their memory is bounded and searches do not wait."""
        self._cached: OrderedDict[PlanKey, MadePlan] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def cached(self, map_: Map, step: int) -> MadePlan | None:
        """The plan of a map if nothing was written to the map since it was made.

        Raises:
            UnknownMap, MapQuarantined.
        """
        state = map_.state
        with self._lock:
            found = self._cached.get(_key(map_, step))
            if found is None or found.state != state:
                return None
            self._cached.move_to_end(_key(map_, step))
            return found

    def make(self, map_: Map, step: int) -> MadePlan:
        """The plan of a map, which is read from disk if it is not cached; blocks.

        Raises:
            PlanTooLarge: it would list more than ``MOST_PLACES``.
            UnknownMap, MapQuarantined, StorageFailure.
        """
        if (found := self.cached(map_, step)) is not None:
            return found
        count = map_.count_places()
        if count > MOST_PLACES * step:
            raise PlanTooLarge(
                f"The map has {count} places, and a plan lists at most {MOST_PLACES}: send "
                f"step={-(-count // MOST_PLACES)} or more."
            )
        state = map_.state  # of now: a write while the plan is read makes it old
        gaps, gap_count = gaps_of(map_)
        columns = f'{map_.plan.columns(step)}, "gaps": {json.dumps(gaps)}, "gap_count": {gap_count}'
        revision = hashlib.sha256(columns.encode()).hexdigest()[:32]
        head = {"map": map_.record.id, "revision": revision, "places": count, "step": step}
        text = f"{json.dumps(head)[:-1]}, {columns}}}"
        made = MadePlan(state, revision, gzip.compress(text.encode(), FAST, mtime=0))
        self._keep(_key(map_, step), made)
        return made

    def _keep(self, key: PlanKey, plan: MadePlan) -> None:
        with self._lock:
            before = self._cached.pop(key, None)
            self._bytes += len(plan.compressed) - (0 if before is None else len(before.compressed))
            self._cached[key] = plan
            while self._bytes > MOST_BYTES or len(self._cached) > MOST_CACHED:
                _, oldest = self._cached.popitem(last=False)
                self._bytes -= len(oldest.compressed)


def gaps_of(map_: Map) -> tuple[list[dict[str, object]], int]:
    """The gaps of a map in metres as the health report counts them, the ``MOST_GAPS`` longest, and how many there are.

    It blocks.

    Raises:
        UnknownMap, MapQuarantined, StorageFailure.
    """
    snapshot = map_.snapshot()
    rows = np.flatnonzero(snapshot.alive)
    where = own_poses(map_.counterparts, snapshot.whereabouts_at(rows), rows)
    if not (where.kind != NO_POSE).any():
        return [], 0
    first = first_looks(where, neighborhood_of(map_))
    found = [(walk, gap) for walk in where.walks() for gap in coverage.long_ways(where, walk, first)]
    found.sort(key=lambda one: -one[1].value)
    ends = [int(rows[walk[gap.before + end]]) for walk, gap in found[:MOST_GAPS] for end in (0, 1)]
    names = ["" if place is None else place.id for place in map_.places_at(ends)]
    listed: list[dict[str, object]] = [
        {"before": before, "after": after, "metres": round(gap.value, 3)}
        for before, after, (_, gap) in zip(names[::2], names[1::2], found, strict=False)
    ]
    return listed, len(found)


def _key(map_: Map, step: int) -> PlanKey:
    return map_.record.id, map_.record.created_at.isoformat(), step
