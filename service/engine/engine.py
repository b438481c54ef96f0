"""What every capability works with: the maps, the encoders, the queue in front of them, and the locks of maps."""

from __future__ import annotations

import asyncio
import gc
import logging
import threading
import time
from collections.abc import AsyncGenerator, Iterator, Sequence
from contextlib import aclosing, contextmanager, suppress
from dataclasses import dataclass, field

from core.errors import MapQuarantined, PlacerecError, UnknownEncoder, UnknownMap, WrongEncoder
from core.frames.images import Limits
from core.frames.masks import Mask
from core.index.exact import compile_ahead
from core.judgement.verdict import Calibration
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder
from core.recognition.selection import Selection
from core.storage import Atlas, Map, MapRecord
from service.engine.queue import Encoded, EncoderQueue, Outcomes, RequestDeadline, Then
from service.engine.searches import Recognized, Searches, search_ahead
from service.errors.faults import EncoderNotInstalled
from service.settings import Settings
from service.telemetry.metrics import MapCollector, Metrics
from service.worker_threads import in_thread as in_thread


@dataclass
class _Lock:
    lock: threading.RLock = field(default_factory=threading.RLock)
    users: int = 0


class MapLocks:
    """One reentrant lock for each map, which exists only while a thread holds it or waits for it.  Thread-safe."""

    def __init__(self) -> None:
        self._locks: dict[str, _Lock] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._locks)

    @contextmanager
    def of(self, map_id: str) -> Iterator[None]:
        """Hold the lock of a map; blocks.  A thread that holds it already may take it again."""
        with self._lock:
            lock = self._locks.setdefault(map_id, _Lock())
            lock.users += 1
        try:
            with lock.lock:
                yield
        finally:
            with self._lock:
                lock.users -= 1
                if not lock.users:
                    del self._locks[map_id]


log = logging.getLogger("placerec.engine")


async def camera_mask(map_: Map, camera: str | None) -> Mask | None:
    """The mask of one of a map's cameras, or None if no camera is named.

    Raises:
        UnknownCamera: the map has no camera of this name.
    """
    return None if camera is None else await in_thread(map_.cameras.mask, camera)


class Engine:
    """The maps of a data directory, the installed encoders, the queue in front of them, and a lock for each map.

    Jobs, sessions, imports and whatever else works with maps are built on an engine; it knows none of them.

    Raises:
        DataDirectoryLocked, DataDirectoryTooNew, StorageFailure: the data directory cannot be opened.
    """

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self.settings, self.metrics = settings, metrics
        self.atlas = Atlas(settings.data_dir)
        self.catalogue = EncoderCatalogue(settings.models_directory, settings.precision, settings.device)
        limits = Limits(max_bytes=settings.max_image_bytes, max_pixels=settings.max_image_pixels)
        self.queue = EncoderQueue(self.catalogue, limits, settings.queue_length, settings.threads, metrics)
        self.searches = Searches()
        self.encoder_state = "loading"
        """The state of the default encoder: "loading", "ok", or a sentence that says why it cannot be used."""
        self._locks = MapLocks()
        self._loading: asyncio.Task[None] | None = None
        self._map_collector = MapCollector(self._count_places, lambda: len(self.atlas.quarantined()))
        metrics.registry.register(self._map_collector)

    def start(self) -> None:
        """Begin to load the default encoder on the running event loop, which goes on meanwhile."""
        self.loop = asyncio.get_running_loop()
        self._loading = asyncio.create_task(self._load_default())

    def close(self) -> None:
        """Drop the frames that wait, and give the data directory back; blocks."""
        self.metrics.registry.unregister(self._map_collector)
        self.queue.close()
        self.atlas.close()

    def stop_loading(self) -> None:
        """Give up loading the default encoder; call it from the event loop."""
        if self._loading is not None:
            self._loading.cancel()

    async def _load_default(self) -> None:
        began = time.perf_counter()
        try:
            identity = await in_thread(self.catalogue.resolve, self.settings.encoder)
            await self.queue.load(identity)
            await in_thread(compile_ahead)
        except PlacerecError as error:
            self.encoder_state = str(error)
            log.error("the default encoder cannot be used: %s", error)
        except Exception:
            self.encoder_state = "it cannot be loaded; the log says why"
            log.exception("the default encoder cannot be loaded")
        else:
            # What is loaded by now stays, so the collector need not walk over it again and again, which takes long.
            gc.collect()
            gc.freeze()
            self.encoder_state = "ok"
            log.info("ready", extra={"encoder": identity, "seconds": round(time.perf_counter() - began, 2)})

    # Maps

    def _count_places(self) -> dict[str, int]:
        counts: dict[str, int] = {}
        for record in self.all_records():
            with suppress(UnknownMap, MapQuarantined):  # deleted, or found to be damaged, since it was listed
                counts[record.id] = self.atlas.find(record.id).count_places()
        return counts

    def all_records(self) -> list[MapRecord]:
        """The records of all maps in service."""
        found, cursor = self.atlas.records(None, 1000)
        records = list(found)
        while cursor is not None:
            found, cursor = self.atlas.records(cursor, 1000)
            records += found
        return records

    @contextmanager
    def writing(self, map_id: str) -> Iterator[None]:
        """Hold a map's lock during a write that depends on what was read before; blocks, so call it in a thread."""
        with self._locks.of(map_id):
            yield

    # Encoders

    def default_calibration(self, identity: str) -> Calibration | None:
        """What an encoder ships with; None if it is not installed."""
        for summary in self.catalogue.describe():
            if summary.identity == identity:
                return summary.calibration
        return None

    def load_encoder(self, map_: Map) -> Encoder:
        """The encoder of a map; blocks, so call it from a thread other than the event loop's.

        Raises:
            EncoderNotInstalled: it is not installed.
        """
        try:
            return asyncio.run_coroutine_threadsafe(self.queue.load(map_.record.encoder), self.loop).result()
        except UnknownEncoder as error:
            raise EncoderNotInstalled(str(error)) from error

    def resolve(self, name_or_identity: str | None) -> str:
        """The identity of an encoder, of the default one for None.

        Raises:
            UnknownEncoder, InvalidModel: it is not installed, or damaged.
        """
        return self.catalogue.resolve(name_or_identity or self.settings.encoder)

    async def map(self, map_id: str) -> Map:
        """A map, opened if need be.

        Raises:
            UnknownMap, MapQuarantined: it is not there, or damaged.
        """
        # Nearly always it is open: no thread has to be asked for it.
        found = self.atlas.opened(map_id)
        return found if found is not None else await in_thread(self.atlas.get, map_id)

    async def encode_for(
        self,
        map_: Map,
        data: bytes,
        deadline: RequestDeadline,
        mask: Mask | None = None,
        then: Then | None = None,
    ) -> Encoded:
        """Encode a frame with a map's encoder; call it within ``queue.place``.

        Raises:
            EncoderNotInstalled: the map's encoder is not here (any more).
            Others: as for ``EncoderQueue.encode``.
        """
        try:
            return await self.queue.encode(map_.record.encoder, data, deadline, mask, then)
        except UnknownEncoder as error:
            raise EncoderNotInstalled(str(error)) from error

    async def recognize(
        self,
        map_: Map,
        data: bytes,
        deadline: RequestDeadline,
        k: int,
        selection: Selection | None = None,
        mask: Mask | None = None,
    ) -> Recognized:
        """Find where one frame was taken: wait in the queue, decode, encode, search, examine, judge.

        Args:
            k: matches to list.
            selection: what is known of the place; None: nothing.
            mask: what of the frame is ignored.

        Raises:
            QueueFull: too many requests wait.
            StorageFailure: the map's files cannot be read.
            Others: as for ``encode_for``.
        """
        with self.queue.place():
            encoded = await self.encode_for(map_, data, deadline, mask, search_ahead(map_, k, selection))
        (recognized,) = await self.searches.recognize(map_, [encoded], k, selection)
        return recognized

    async def encode_many(
        self,
        identity: str,
        frames: Sequence[bytes],
        deadline: RequestDeadline,
        masks: Sequence[Mask | None] | None = None,
    ) -> AsyncGenerator[Outcomes]:
        """Encode many frames, as ``EncoderQueue.encode_many`` does; close the generator (``contextlib.aclosing``).

        Args:
            identity: of the encoder of the map that the frames are for.

        Raises:
            EncoderNotInstalled: the encoder is not installed (any more).
            Others: as for ``EncoderQueue.encode_many``.
        """
        async with aclosing(self.queue.encode_many(identity, frames, deadline, masks)) as outcomes:
            async for some in outcomes:
                for _, outcome in some:
                    if isinstance(outcome, UnknownEncoder):
                        raise EncoderNotInstalled(str(outcome)) from outcome
                yield some

    async def encode_all(
        self,
        identity: str,
        frames: Sequence[bytes],
        deadline: RequestDeadline,
        masks: Sequence[Mask | None] | None = None,
    ) -> list[Encoded | Exception]:
        """What became of each of many frames, in their order, without the pixels, which would fill the memory."""
        made: dict[int, Encoded | Exception] = {}
        async with aclosing(self.encode_many(identity, frames, deadline, masks)) as outcomes:
            async for some in outcomes:
                for index, outcome in some:
                    made[index] = outcome if isinstance(outcome, Exception) else outcome.without_pixels()
        return [made[index] for index in range(len(frames))]

    def assert_encoder(self, map_: Map, asserted: str | None) -> None:
        """See that the encoder that a caller names is the map's.

        Raises:
            WrongEncoder: it is not.
        """
        identity = map_.record.encoder
        if asserted is None or asserted in (identity, identity.partition("@")[0]):
            return
        raise WrongEncoder(f"The map {map_.record.id} is bound to {identity}, not to {asserted[:140]}.")
