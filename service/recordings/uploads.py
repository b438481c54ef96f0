"""Bags on disk: they arrive in pieces, each where the one before has ended, so that an upload goes on after a break.

recordings/<map>/<name>       what has arrived so far; the name ends as the kind of bag asks for

A bag stays until a job has enrolled all its frames, somebody deletes it, or nothing was done with it for a day.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from core.disk.files import disk_errors, make_folder, sync_folder, write_at
from core.disk.permissions import open_private
from core.errors import StorageFull
from core.recordings.messages import check_installed
from service.errors.faults import DigestMismatch, RecordingInUse, RecordingOffset, StagingFull, UnknownRecording
from service.fairness import CALLER
from service.http.bodies import in_pieces
from service.jobs.job import Job
from service.jobs.jobs import Jobs
from service.places.staging import RESERVE
from service.settings import Settings
from service.worker_threads import in_thread, to_its_end

FOLDER = "recordings"
KIND = "enrol-recording"

IDLE_SECONDS = 24 * 3600.0
"""Without a request or a job for this time, what has arrived of a recording is removed."""

MOST_BAGS = 1000
"""Bags of a service; each piece looks at all of them."""


class Recordings:
    """The bags of a service.  Thread-safe.

    Args:
        settings: ``max_recording_bytes`` is the most that all bags together may have; when they have as many, further
            pieces are taken of callers that have less than an equal share of them.
        jobs: which read them.
    """

    def __init__(self, settings: Settings, jobs: Jobs) -> None:
        self._folder, self._most, self._jobs = settings.data_dir / FOLDER, settings.max_recording_bytes, jobs
        self._lock = threading.Lock()
        self._arriving: set[Path] = set()
        self._callers: dict[Path, str] = {}
        """The caller that sent each bag; one from before a restart counts as anyone's."""

    def path(self, map_id: str, name: str) -> Path:
        """The file of a bag; it need not exist."""
        return self._folder / map_id / name

    def size(self, map_id: str, name: str) -> int:
        """How many bytes of a bag are here; 0: nothing is.

        Raises:
            StorageFailure.
        """
        path = self.path(map_id, name)
        with disk_errors("read a recording"):
            return path.stat().st_size if path.exists() else 0

    def is_from_caller(self, map_id: str, name: str) -> bool:
        """Whether the latest piece of a bag that is here came from the present caller; a restart forgets that."""
        with self._lock:
            return self._callers.get(self.path(map_id, name)) == CALLER.get()

    def find(self, map_id: str, name: str) -> Path:
        """The file of a bag of which something is here.

        Raises:
            UnknownRecording: nothing is.
            StorageFailure.
        """
        if not self.size(map_id, name):
            raise UnknownRecording(f"Nothing of the recording {name!r} is here.")
        return self.path(map_id, name)

    async def receive(self, map_id: str, name: str, offset: int, chunks: AsyncIterator[bytes]) -> int:
        """Add a piece to a bag; returns how many bytes of it are here then.

        If the piece breaks off, its part stays; of one that does not have its digest nothing does.

        Args:
            offset: where the piece begins; 0 begins anew only if nothing is here.

        Raises:
            MissingExtra: the reader of bags is not installed.
            RecordingOffset: the bytes that are here end elsewhere, or another piece of the bag is arriving.
            RecordingInUse: a job reads the bag.
            StagingFull: the bags of the service would have too many bytes, or would be too many.
            UnknownRecording: its map was deleted while the piece was arriving.
            StorageFull, StorageFailure, and the errors of ``chunks``.
        """
        await in_thread(check_installed)
        path = self.path(map_id, name)
        with self._alone(path):
            descriptor = await to_its_end(partial(self._open, map_id, name, offset))
            at = offset
            try:
                async for piece in in_pieces(chunks):
                    await to_its_end(partial(self._write, path, descriptor, piece, at))
                    at += len(piece)
                await to_its_end(partial(_sync, descriptor))
            except DigestMismatch:
                os.ftruncate(descriptor, offset)
                raise
            finally:
                os.close(descriptor)
            return at

    @contextmanager
    def unused(self, map_id: str, name: str) -> Iterator[None]:
        """A moment in which no job wants a bag and no piece of it arrives, so that a job can be submitted for it.

        Raises:
            UnknownRecording: nothing of it is here.
            RecordingInUse.
            StorageFailure.
        """
        path = self.find(map_id, name)
        try:
            with self._alone(path):
                self.check_unused(map_id, name)
                yield
        except RecordingOffset as error:
            raise RecordingInUse(f"A piece of the recording {name!r} is arriving.") from error

    @contextmanager
    def _alone(self, path: Path) -> Iterator[None]:
        with self._lock:
            if path in self._arriving:
                raise RecordingOffset("Another piece of this recording is arriving.")
            self._arriving.add(path)
        try:
            yield
        finally:
            with self._lock:
                self._arriving.discard(path)

    def _open(self, map_id: str, name: str, offset: int) -> int:
        self.clean()
        self.check_unused(map_id, name)
        path = self.path(map_id, name)
        with disk_errors("store a recording"):
            here = path.stat().st_size if path.exists() else 0
            if here != offset:
                raise RecordingOffset(f"{here} bytes of this recording are here: the next piece has the offset {here}.")
            if not path.exists():
                self._check_share(path, lambda _bag: 1, 1, MOST_BAGS)
            make_folder(path.parent)
            descriptor = open_private(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC)
            sync_folder(path.parent)
            return descriptor

    def _write(self, path: Path, descriptor: int, piece: bytes, at: int) -> None:
        with disk_errors("store a recording"):
            if not os.fstat(descriptor).st_nlink:  # it would take room that nobody counts
                raise UnknownRecording("The recording was removed while this piece of it arrived.")
            self._check_share(path, lambda bag: bag.stat().st_size, len(piece), self._most)
            if shutil.disk_usage(self._folder).free < len(piece) + RESERVE:
                raise StorageFull("The disk has no room for the recording beside the maps.")
            write_at(descriptor, piece, at)

    def _check_share(self, path: Path, size: Callable[[Path], int], more: int, most: int) -> None:
        """Refuse more of a bag when all of them have the most, and its sender an equal share of that.

        Raises:
            StagingFull.
        """
        caller, held = CALLER.get(), Counter[str]()
        with self._lock:
            self._callers[path] = caller
            callers = dict(self._callers)
        for bag in self._folder.glob("*/*"):
            with suppress(FileNotFoundError):
                held[callers.get(bag, caller)] += size(bag)
        share = most // len({*held, caller})
        if held.total() + more > most and held[caller] + more > share:
            raise StagingFull("The recordings that wait leave no room for more; send it again later.")

    def check_unused(self, map_id: str, name: str) -> None:
        """Refuse what changes a bag while a job reads it, or waits to.

        Raises:
            RecordingInUse.
        """
        if (map_id, name) in self._wanted():
            raise RecordingInUse(f"A job enrols the recording {name!r}.")

    def _wanted(self) -> set[tuple[str | None, str]]:
        """The bags that jobs read or wait for."""
        return {(job.map_id, str(job.arguments["recording"])) for job in self._jobs.all() if _reads(job)}

    def remove(self, map_id: str, name: str) -> None:
        """Remove what has arrived of a bag.

        Raises:
            UnknownRecording: nothing has.
            RecordingInUse: a job reads it.
            RecordingOffset: a piece of it is arriving.
            StorageFailure.
        """
        self.find(map_id, name)
        with self._alone(self.path(map_id, name)):
            self.check_unused(map_id, name)
            self._remove(self.path(map_id, name))

    def remove_all(self, map_id: str) -> int:
        """Remove the bags of a map but for those that a job wants or of which a piece arrives; how many were removed.

        Raises:
            StorageFailure.
        """
        count = 0
        for name in self.names(map_id):
            with suppress(UnknownRecording, RecordingInUse, RecordingOffset):
                self.remove(map_id, name)
                count += 1
        return count

    def names(self, map_id: str) -> list[str]:
        """The bags of a map of which something is here.

        Raises:
            StorageFailure.
        """
        with disk_errors("read recordings"):
            return sorted(path.name for path in (self._folder / map_id).glob("*"))

    def _remove(self, path: Path) -> None:
        with disk_errors("remove a recording"):
            path.unlink(missing_ok=True)
            with suppress(OSError):  # others are in it
                path.parent.rmdir()
        with self._lock:
            self._callers.pop(path, None)

    def forget_map(self, map_id: str) -> None:
        """Remove the bags of a map that was deleted, which a later map of its name must not get.

        Raises:
            StorageFailure.
        """
        for path in list((self._folder / map_id).glob("*")):
            self._remove(path)

    def job_ended(self, job: Job) -> None:
        """Remove the bag of a job that has enrolled all its frames; of another one it stays, to be tried again."""
        if job.result is not None and not job.result["failed"]["count"]:
            self._remove(self.path(str(job.map_id), str(job.arguments["recording"])))

    def clean(self) -> None:
        """Remove the bags with which nothing was done for a day.

        Raises:
            StorageFailure.
        """
        oldest, wanted = time.time() - IDLE_SECONDS, self._wanted()
        with disk_errors("remove recordings"):
            for path in list(self._folder.glob("*/*")):
                used = (path.parent.name, path.name) in wanted or path in self._arriving
                if not used and path.stat().st_mtime < oldest:
                    self._remove(path)


def _reads(job: Job) -> bool:
    return job.kind == KIND and not job.ended


def _sync(descriptor: int) -> None:
    with disk_errors("store a recording"):
        os.fsync(descriptor)
