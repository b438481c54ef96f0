"""Durable maps: a write that has returned is on disk, whatever is read from disk is checked, searches run in memory."""

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
from core.maps.status import IndexStatus, Recall, StorageStatus
from core.maps.store import Ranking
from core.storage.atlas import Atlas
from core.storage.map import Map
from core.storage.search.snapshot import Snapshot

__all__ = [
    "Atlas",
    "Change",
    "Enrolment",
    "History",
    "IndexStatus",
    "Keep",
    "KeptFrame",
    "Map",
    "MapRecord",
    "MapSettings",
    "Precision",
    "Ranking",
    "Recall",
    "ReviewFrame",
    "ReviewSetting",
    "SameFrame",
    "SequenceSummary",
    "Snapshot",
    "StorageStatus",
    "TierSetting",
    "VerifyReport",
]
