"""Opening the store of maps that the settings name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from core.disk.files import FolderLock, disk_errors, make_folder
from core.disk.permissions import close_to_others
from core.store import Directory, Store, open_cluster
from service.access import key_file
from service.open_files import most_open_maps
from service.settings import Settings

if TYPE_CHECKING:
    from core.index.milvus import Milvus


class OpenStore:
    """The store of a service, and the lock on its data directory, which is closed to others; close it at the end.

    Servers are not waited for: without one that can be reached the service starts and is not ready.

    Raises:
        DataDirectoryLocked, DataDirectoryTooNew, DataDirectoryTooOld, StorageFull, StorageFailure: the data directory
            cannot be opened.
        MissingExtra: the client of the servers is not installed.
    """

    def __init__(self, settings: Settings) -> None:
        self.maps: Store
        self.most_open: int
        """The number of maps that may be open at the same time."""
        self._lock: FolderLock | None = None
        with disk_errors(f"open the data directory {settings.data_dir}"):
            make_folder(settings.data_dir)
            close_to_others(settings.data_dir, but=frozenset({key_file.FILE}))
        self.most_open = most_open_maps(settings)
        if settings.database is None:
            self.maps = Directory(settings.data_dir, self.most_open, milvus=_milvus(settings))
            return
        with disk_errors(f"open the data directory {settings.data_dir}"):
            self._lock = FolderLock(settings.data_dir / "LOCK")
        try:
            cluster = open_cluster(settings.database.get_secret_value(), settings.row_cache_bytes, _milvus(settings))
        except BaseException:
            self._lock.release()
            raise
        cluster.start_sweeping()
        self.maps = cluster

    def close(self) -> None:
        """Wait for reads and writes under way, close the store, and release the data directory."""
        self.maps.close()
        if self._lock is not None:
            self._lock.release()


def _milvus(settings: Settings) -> Milvus | None:
    """The Milvus that the settings name; its client is imported for it alone."""
    if settings.milvus is None:
        return None
    from core.index.milvus import Milvus

    certificate = settings.milvus_certificate
    return Milvus(
        settings.milvus,
        settings.milvus_token.get_secret_value(),
        settings.milvus_database,
        None if certificate is None else str(certificate),
    )
