"""Maps, whatever stores them: their records, and a caller's knowledge of a place."""

from core.maps.counterparts import Correspondence, own_poses
from core.maps.enrolling import Reject, refuse_all
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
from core.maps.review import ReviewFrame
from core.maps.selection import Selection
from core.maps.status import ErasureReport, IndexStatus, Recall, StorageStatus

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
    "MapRecord",
    "MapSettings",
    "PicturedPlace",
    "PlaceFilter",
    "Precision",
    "Recall",
    "Reject",
    "RejectedGround",
    "ReviewFrame",
    "ReviewSetting",
    "SameFrame",
    "Selection",
    "SequenceSummary",
    "StorageStatus",
    "TierSetting",
    "VerifyReport",
    "own_poses",
    "refuse_all",
]
