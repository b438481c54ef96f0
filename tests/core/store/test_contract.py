"""The store in a data directory does what is asked of every store."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from hypothesis import settings

from core.store import Directory, Store
from tests.core.maps.contract import StoreContract


class DataDirectory(StoreContract):
    """A data directory with segments of four rows."""

    def __init__(self) -> None:
        super().__init__()
        self.directory = Path(tempfile.mkdtemp(prefix="placerec-contract-"))

    def opened(self) -> Store:
        return Directory(self.directory, rows_per_segment=4)

    def teardown(self) -> None:
        self.store.close()
        shutil.rmtree(self.directory)


DataDirectory.TestCase.settings = settings(max_examples=15, stateful_step_count=20, deadline=None)
TestDataDirectory = DataDirectory.TestCase
