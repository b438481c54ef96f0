"""Durable maps: what is acknowledged is on disk, what is on disk is checked, what is searched is in memory."""

from core.storage.atlas import Atlas
from core.storage.map import Map
from core.storage.records import (
    Change,
    Enrolment,
    Keep,
    MapRecord,
    MapSettings,
    SequenceSummary,
    VerifyReport,
)
from core.storage.snapshot import Ranking, Snapshot

__all__ = [
    "Atlas",
    "Change",
    "Enrolment",
    "Keep",
    "Map",
    "MapRecord",
    "MapSettings",
    "Ranking",
    "SequenceSummary",
    "Snapshot",
    "VerifyReport",
]
