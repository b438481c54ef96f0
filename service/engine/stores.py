"""Opening the store of maps that the settings name."""

from __future__ import annotations

from typing import Protocol

from core.disk.files import FolderLock, disk_errors, make_folder
from core.disk.permissions import close_to_others
from core.maps import Store
from core.milvus import open_store
from core.postgres import Bucket, open_database
from core.storage import Atlas
from service.access import key_file
from service.open_files import most_open_maps
from service.settings import Settings


class SweptStore(Store, Protocol):
    """A store that several services use."""

    def start_sweeping(self) -> None:
        """Delete what others have left, now and from time to time."""


class OpenStore:
    """The store of a service, and the lock on its data directory, which is closed to others; close it at the end.

    Servers are not waited for: without one that can be reached the service starts and is not ready.

    Raises:
        DataDirectoryLocked, DataDirectoryTooNew, StorageFull, StorageFailure: the data directory cannot be opened.
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
        if settings.engine == "files":
            self.maps = Atlas(settings.data_dir)
            return
        with disk_errors(f"open the data directory {settings.data_dir}"):
            self._lock = FolderLock(settings.data_dir / "LOCK")
        try:
            store = _store(settings)
        except BaseException:
            self._lock.release()
            raise
        store.start_sweeping()
        self.maps = store

    def close(self) -> None:
        """Wait for reads and writes under way, close the store, and release the data directory."""
        self.maps.close()
        if self._lock is not None:
            self._lock.release()


def _store(settings: Settings) -> SweptStore:
    """The store of maps in a database."""
    assert settings.database is not None  # the settings were checked
    address = settings.database.get_secret_value()
    if settings.engine == "postgres":
        return open_database(address, _bucket(settings), settings.row_cache_bytes)
    assert settings.milvus is not None
    certificate = settings.milvus_certificate
    return open_store(
        settings.milvus,
        address,
        settings.milvus_token.get_secret_value(),
        settings.milvus_database,
        None if certificate is None else str(certificate),
        _bucket(settings),
    )


def _bucket(settings: Settings) -> Bucket | None:
    if settings.objects is None:
        return None
    certificate = settings.objects_certificate
    return Bucket(
        settings.objects,
        settings.objects_endpoint,
        settings.objects_region,
        settings.objects_access_key,
        settings.objects_secret_key.get_secret_value(),
        None if certificate is None else str(certificate),
    )
