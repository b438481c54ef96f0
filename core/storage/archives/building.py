"""Making the folder of a new map from an export file; every descriptor gets new checksums."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from core.disk.files import Damage, sync_file, sync_folder
from core.disk.sqlite_file import transaction
from core.ledger.maps.record import state_of
from core.maps.archives.lines import MOST_PICTURE_BYTES
from core.maps.archives.reading import Archive
from core.maps.enrolling import CheckDescriptors, any_descriptors
from core.maps.records import MapRecord
from core.storage.archives.importing import Importing
from core.storage.archives.unpacking import Advance, CheckPicture, check_sizes, layout_of
from core.storage.database.connections import FILE, connect
from core.storage.database.schema import connection_of
from core.storage.database.segments import segment_entries
from core.storage.files.segment_files import ROWS_PER_SEGMENT
from core.storage.opening import create_folder
from core.storage.review import FILE as REVIEW_FILE
from core.storage.review import ReviewFrames
from core.storage.writing import AppendingWrite


def build(
    archive: Archive,
    folder: Path,
    map_id: str,
    rows_per_segment: int = ROWS_PER_SEGMENT,
    advance: Advance = lambda _done, _all: None,
    check_picture: CheckPicture = lambda _content: None,
    most_picture_bytes: int = MOST_PICTURE_BYTES,
    check_descriptors: CheckDescriptors = any_descriptors,
) -> int:
    """Make ``folder`` with the map of an export file in it, durable except for the folder's own name.

    Args:
        map_id: of the new map; it may differ from that in the file.
        most_picture_bytes: a larger picture is refused before it is read.
        check_descriptors: says which descriptors the map's encoder can have given.

    Returns:
        The number of places, their looks apart.

    Raises:
        InvalidArchive: the file is damaged, or its content is not valid for a map; ``folder`` is then of no use.
        OSError, sqlite3.Error: the disk refuses.
    """
    manifest = archive.manifest
    check_sizes(manifest)
    record = MapRecord.model_validate({**manifest.map.model_dump(), "id": map_id})
    create_folder(folder, record, rows_per_segment)
    driver = connect(folder / FILE)
    connection, layout = connection_of(driver), layout_of(manifest, rows_per_segment)

    @contextmanager
    def writing() -> Iterator[AppendingWrite]:
        with transaction(driver):
            write = AppendingWrite(connection, state_of(connection, map_id), folder, layout)
            yield write
            write.finish()

    review = ReviewFrames(folder / REVIEW_FILE, map_id, lambda: None)
    try:
        importing = Importing(
            archive, layout, advance, check_picture, most_picture_bytes, writing, review, check_descriptors
        )
        importing.fill()
        for (line,) in driver.execute("PRAGMA quick_check").fetchall():
            if line != "ok":
                raise Damage(f"{FILE}: {line}")
        if sum(segment.rows for segment in segment_entries(connection, layout)) != importing.rows:
            raise Damage(f"{FILE} does not record the rows that were written")
    finally:
        review.close()
        driver.close()  # SQLite moves its log into the file and deletes it
    sync_file(folder / FILE)
    sync_folder(folder)
    return importing.places
