"""Durable maps: a write that has returned is on disk, whatever is read from disk is checked, searches run in memory."""

from core.storage.atlas import Atlas
from core.storage.map import Map
from core.storage.search.snapshot import Snapshot

__all__ = ["Atlas", "Map", "Snapshot"]
