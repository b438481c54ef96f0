"""After a write that failed: are the files what was acknowledged last?"""

from __future__ import annotations

import logging
import sqlite3
from pathlib import Path

from core.disk.files import Damage, primary_code
from core.storage.database.segment_table import named_segments
from core.storage.files import segment_files as descriptors
from core.storage.opening import OpenMap
from core.storage.writing import Write

log = logging.getLogger(__name__)


class Doubts:
    """What stands behind what was acknowledged last, in the segment files and in SQLite's log of one map?

    For the thread that writes.
    """

    def __init__(self, folder: Path) -> None:
        """Of the map in ``folder``: none yet."""
        self._folder = folder
        self._rows = False
        self._log = False

    def arise(self, error: BaseException, write: Write, opened: OpenMap, rows: int) -> None:
        """A write to a map of ``rows`` rows failed with ``error``; before it appended or was committed that is nothing.

        A COMMIT that found no room wrote no end of the transaction; after any other failure of
        one the log must be emptied first, or a crash could bring that transaction to life.
        """
        found_no_room = isinstance(error, sqlite3.Error) and primary_code(error) == sqlite3.SQLITE_FULL
        self._rows |= write.appending
        self._log |= write.committing and not found_no_room
        try:
            self.resolve(opened, rows)
        except (OSError, sqlite3.Error, Damage) as further:
            log.warning("Map %s takes no writes until its files are in order again: %s", self._folder.name, further)

    def resolve(self, opened: OpenMap, rows: int) -> None:
        """Bring the files back to the ``rows`` rows acknowledged last; no write is begun until this succeeds.

        Raises:
            OSError, sqlite3.Error: the disk refuses.
            Damage: what was acknowledged is not there.
        """
        if self._log:
            opened.database.settle()
            self._log = False
        if self._rows:
            descriptors.rewind(self._folder, opened.layout, rows)
            # The failed sync may have lost a block that holds the end of the last good row, too.
            with opened.database.reading() as connection:
                named = named_segments(connection, opened.layout)
            if sum(segment.rows for segment in named) != rows:
                raise Damage("map.sqlite names other rows than were acknowledged")
            for last in named[-1:]:
                for _ in descriptors.read_checked(self._folder, opened.layout, last.number, last.rows, last.checksum):
                    pass
            self._rows = False
