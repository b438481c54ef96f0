"""What a map is, whatever stores it: its records, what a caller knows of a place, and what is asked of a store."""

from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import Enrolment, MapRecord, MapSettings, SameFrame
from core.maps.selection import Selection
from core.maps.store import Map, Ranking, Scope, Snapshot, Store

__all__ = [
    "EVERY_PLACE",
    "Enrolment",
    "Map",
    "MapRecord",
    "MapSettings",
    "PlaceFilter",
    "Ranking",
    "SameFrame",
    "Scope",
    "Selection",
    "Snapshot",
    "Store",
]
