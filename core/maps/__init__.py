"""What a map is, whatever stores it: its records, what a caller knows of a place, and what is asked of a store."""

from core.maps.counterparts import Correspondence
from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import (
    Change,
    Enrolment,
    History,
    Keep,
    KeptFrame,
    MapRecord,
    MapSettings,
    Precision,
    ReviewSetting,
    SameFrame,
    SequenceSummary,
    TierSetting,
    VerifyReport,
)
from core.maps.review import ReviewFrame
from core.maps.selection import Selection
from core.maps.status import IndexStatus, Recall, StorageStatus
from core.maps.store import Map, Ranking, Scope, Snapshot, Store

__all__ = [
    "EVERY_PLACE",
    "Change",
    "Correspondence",
    "Enrolment",
    "History",
    "IndexStatus",
    "Keep",
    "KeptFrame",
    "Map",
    "MapRecord",
    "MapSettings",
    "PlaceFilter",
    "Precision",
    "Ranking",
    "Recall",
    "ReviewFrame",
    "ReviewSetting",
    "SameFrame",
    "Scope",
    "Selection",
    "SequenceSummary",
    "Snapshot",
    "StorageStatus",
    "Store",
    "TierSetting",
    "VerifyReport",
]
