"""Maps, whatever stores them: their records, a caller's knowledge of a place, and the interfaces of a store."""

from core.maps.counterparts import Correspondence, own_poses
from core.maps.place_filter import EVERY_PLACE, PlaceFilter
from core.maps.records import (
    AlarmLimit,
    AlarmName,
    AlarmSetting,
    Change,
    Enrolment,
    History,
    Keep,
    LearningSetting,
    MapRecord,
    MapSettings,
    PicturedPlace,
    Precision,
    RejectedGround,
    ReviewSetting,
    SameFrame,
    SequenceSummary,
    TierSetting,
    VerifyReport,
)
from core.maps.review import ReviewFrame, stored_frames
from core.maps.selection import Selection
from core.maps.status import ErasureReport, IndexStatus, Recall, StorageStatus
from core.maps.store import Map, Ranking, Reject, Scope, Snapshot, Store, refuse_all

__all__ = [
    "EVERY_PLACE",
    "AlarmLimit",
    "AlarmName",
    "AlarmSetting",
    "Change",
    "Correspondence",
    "Enrolment",
    "ErasureReport",
    "History",
    "IndexStatus",
    "Keep",
    "LearningSetting",
    "Map",
    "MapRecord",
    "MapSettings",
    "PicturedPlace",
    "PlaceFilter",
    "Precision",
    "Ranking",
    "Recall",
    "Reject",
    "RejectedGround",
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
    "own_poses",
    "refuse_all",
    "stored_frames",
]
