"""The graphs of places that sessions are about, built again when their maps have changed."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Iterable
from dataclasses import dataclass

from core.belief import PlaceGraph, place_graph
from core.maps.selection import Selection
from core.recognition.stages import neighborhood_of
from core.store import Map, Snapshot
from service.sessions.session import Session, creation_time

GRAPH_REUSE = 20.0
"""The graph of a map that changes is used for this multiple of the time it took to build, then built again."""


@dataclass(frozen=True, eq=False)
class _CachedGraph:
    """The graph of a map's snapshot.

    snapshot: is not kept, for what was deleted from the map cannot be erased while a snapshot of before is in use.
    made: when it was finished, by the monotonic clock.
    took: how many seconds it took to build.
    """

    snapshot: weakref.ref[Snapshot]
    graph: PlaceGraph
    made: float
    took: float

    def serves(self, snapshot: Snapshot, now: float) -> bool:
        """Whether the graph is that of the snapshot, or recent enough to be used for it."""
        return self.snapshot() is snapshot or now - self.made < GRAPH_REUSE * self.took


class SessionGraphs:
    """The graphs of the maps and sequences that sessions use.  Any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._graphs: dict[tuple[str, str, tuple[str, ...]], _CachedGraph] = {}

    def __len__(self) -> int:
        return len(self._graphs)

    def graph(self, map_: Map, selection: Selection | None) -> PlaceGraph:
        """The graph of the selected places of a map; while the map changes it may be slightly out of date."""
        names = selection.filters.sequences or () if selection else ()
        key = (map_.record.id, creation_time(map_), names)
        neighborhood = neighborhood_of(map_)
        with self._lock:
            snapshot, known, now = map_.snapshot(), self._graphs.get(key), time.monotonic()
            if known is not None and known.graph.neighborhood == neighborhood and known.serves(snapshot, now):
                return known.graph
            scope = map_.scope(selection)
            snapshot = scope.snapshot
            graph = place_graph(snapshot.whereabouts, scope.living_rows(), snapshot.rows, neighborhood)
            done = time.monotonic()
            self._graphs[key] = _CachedGraph(weakref.ref(snapshot), graph, done, done - now)
            return graph

    def drop_unused(self, sessions: Iterable[Session]) -> None:
        """Drop the graphs that none of these sessions, which are all, uses."""
        used = {(one.map_id, one.map_created_at, tuple(one.options.sequences or ())) for one in sessions}
        for key in list(self._graphs):
            if key not in used:
                self._graphs.pop(key, None)
