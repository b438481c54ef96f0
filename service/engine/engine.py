"""The engine: maps, encoders, the queue in front of the encoders, searches, events, and one lock for each map."""

from __future__ import annotations

import asyncio
import gc
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import aclosing, contextmanager, suppress
from dataclasses import dataclass, field

from core.disk.reserve import Reserve
from core.errors import (
    InvalidModel,
    MapQuarantined,
    PlacerecError,
    StoreUnavailable,
    UnknownEncoder,
    UnknownMap,
    WrongEncoder,
)
from core.frames.images import Limits
from core.frames.masks import Mask
from core.judgement.verdict import Calibration
from core.maps import MapRecord
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.recognition.question import Question
from core.recognition.recognition import needs_keypoints
from core.store import Map, Store
from service.engine.encoders import Encoded
from service.engine.queue import EncoderQueue, RequestDeadline
from service.engine.rehearsal import rehearse
from service.engine.review_keeper import ReviewKeeper
from service.engine.searches import Answered, Searches, search_ahead
from service.engine.stores import OpenStore
from service.errors.problems import told
from service.events.events import Events
from service.malloc import return_free_memory
from service.settings import Settings
from service.telemetry.metrics import MapCollector, Metrics
from service.worker_threads import in_thread as in_thread


@dataclass
class _Lock:
    lock: threading.RLock = field(default_factory=threading.RLock)
    users: int = 0


class MapLocks:
    """One reentrant lock for each map; a lock exists only while a thread holds it or waits for it.  Thread-safe."""

    def __init__(self) -> None:
        self._locks: dict[str, _Lock] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._locks)

    @contextmanager
    def of(self, map_id: str) -> Iterator[None]:
        """Hold the lock of a map; blocks.  A thread that already holds the lock may take it again."""
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
    """The mask of one of a map's cameras; None if ``camera`` is None or the camera has no mask.

    Raises:
        UnknownCamera: the map has no camera of this name.
    """
    return None if camera is None else await in_thread(map_.cameras.mask, camera)


class Engine:
    """The maps of a store, their events, the installed encoders with their queue, and a lock for each map.

    Jobs, sessions, imports and all other capabilities are built on an engine, which imports none of them.

    Raises:
        DataDirectoryLocked, DataDirectoryTooNew, StorageFailure: the data directory cannot be opened.
        MissingExtra: the store of the settings needs a package that is not installed.
    """

    def __init__(self, settings: Settings, metrics: Metrics, events: Events | None = None) -> None:
        self.settings, self.metrics = settings, metrics
        self._store = OpenStore(settings)
        self.maps: Store = self._store.maps
        self.most_open_maps = self._store.most_open
        self.catalogue = EncoderCatalogue(settings.models_directory, settings.device)
        limits = Limits(max_bytes=settings.max_image_bytes, max_pixels=settings.max_image_pixels)
        self.queue = EncoderQueue(self.catalogue, limits, settings.queue_length, settings.threads, metrics)
        self.searches = Searches()
        self.events = Events(settings.event_listeners) if events is None else events
        self.review_keeper = ReviewKeeper()
        self.reserve = Reserve(settings.data_dir, settings.disk_reserve_bytes)
        """Room for what deletes something."""
        self.encoder_state = self.public_encoder_state = "loading"
        """The state of the default encoder: "loading", "ok", or a sentence that says why it cannot be used; the second
        for those who may not know addresses and paths."""
        self._locks = MapLocks()
        self._loading: asyncio.Task[None] | None = None
        self._map_collector = MapCollector(self._count_places, lambda: len(self.maps.quarantined()))
        metrics.registry.register(self._map_collector)

    def start(self) -> None:
        """Begin to load the default encoder in the background; call it from the event loop."""
        self.loop = asyncio.get_running_loop()
        self.reserve.hold()
        self._loading = asyncio.create_task(self._load_default())

    def close(self) -> None:
        """Cancel the waiting frames and release the data directory; blocks."""
        self.events.stop_soon()
        self.metrics.registry.unregister(self._map_collector)
        self.queue.close()
        self.review_keeper.close()
        self._store.close()

    def stop_loading(self) -> None:
        """Cancel the loading of the default encoder; call it from the event loop."""
        if self._loading is not None:
            self._loading.cancel()

    async def _load_default(self) -> None:
        began = time.perf_counter()
        try:
            identity = await in_thread(self.catalogue.resolve, self.settings.encoder)
            encoder = await self.queue.load(identity)
            await in_thread(packaged_xfeat)  # which finds keypoints
            if self.settings.rehearsal:
                await in_thread(rehearse, encoder)
        except PlacerecError as error:
            self.encoder_state, self.public_encoder_state = str(error), told(error, False)
            log.error("the default encoder cannot be used: %s", error)
        except Exception:
            self.encoder_state = self.public_encoder_state = "it cannot be loaded; the log says why"
            log.exception("the default encoder cannot be loaded")
        else:
            # Objects that are loaded by now live as long as the process: the garbage collector can skip them.
            gc.collect()
            gc.freeze()
            await in_thread(return_free_memory)  # what loading took and needs no more
            self.encoder_state = self.public_encoder_state = "ok"
            log.info("ready", extra={"encoder": identity, "seconds": round(time.perf_counter() - began, 2)})

    # Maps

    def _count_places(self) -> dict[str, int]:
        counts: dict[str, int] = {}
        with suppress(StoreUnavailable):  # the metrics of everything else are wanted most then
            for record in self.all_records():
                with suppress(UnknownMap, MapQuarantined):  # it was deleted or quarantined since it was listed
                    counts[record.id] = self.maps.find(record.id).count_places()
        return counts

    def all_records(self) -> list[MapRecord]:
        """The records of all maps that are in service (not quarantined)."""
        found, cursor = self.maps.records(None, 1000)
        records = list(found)
        while cursor is not None:
            found, cursor = self.maps.records(cursor, 1000)
            records += found
        return records

    @contextmanager
    def writing(self, map_id: str) -> Iterator[None]:
        """Hold a map's lock during a read and the write that depends on it; blocks, so call it in a thread."""
        with self._locks.of(map_id):
            yield

    # Encoders

    def default_calibration(self, identity: str) -> Calibration | None:
        """The calibration that an encoder ships with; None if the encoder is not installed."""
        try:
            return self.catalogue.summary(identity).calibration
        except (UnknownEncoder, InvalidModel):
            return None

    def load_encoder(self, map_: Map) -> Encoder:
        """The encoder of a map; blocks, so call it in a thread, never on the event loop.

        Raises:
            EncoderNotInstalled: the map's encoder is not installed.
            InvalidModel: its files are damaged.
        """
        return asyncio.run_coroutine_threadsafe(self.queue.load(map_.record.encoder), self.loop).result()

    def resolve(self, name_or_identity: str | None) -> str:
        """The identity of an encoder, given its name or identity; that of the default encoder for None.

        Raises:
            UnknownEncoder: no such encoder is installed.
            InvalidModel: its files are damaged.
        """
        return self.catalogue.resolve(name_or_identity or self.settings.encoder)

    async def map(self, map_id: str) -> Map:
        """A map, which is read if it is not open yet.

        Raises:
            UnknownMap: there is no map of this id.
            MapQuarantined: the map is damaged.
        """
        # The map is nearly always open, and then no thread is needed.
        found = self.maps.opened(map_id)
        return found if found is not None else await in_thread(self.maps.get, map_id)

    async def ask(self, map_: Map, data: bytes, question: Question, deadline: RequestDeadline) -> Answered:
        """Find where one frame was taken: wait in the queue, decode, encode, search, compare cells, verify, judge.

        Args:
            data: the bytes of a JPEG, PNG or WebP file.

        Raises:
            UnknownCamera: the map has no camera of the question's name.
            QueueFull: too many requests are waiting.
            StorageFailure: the map cannot be read.
            Others: see ``EncoderQueue.encode``.
        """
        mask = await camera_mask(map_, question.camera)
        ahead = search_ahead(map_, question)
        with self.queue.place():
            keypoints = needs_keypoints(map_, question)
            frame = await self.queue.encode(map_.record.encoder, data, deadline, mask, ahead, keypoints)
        (answered,) = await self.searches.answer(map_, [frame], question)
        return answered

    async def encode_all(
        self,
        identity: str,
        frames: Sequence[bytes],
        deadline: RequestDeadline,
        masks: Sequence[Mask | None] | None = None,
        keep_scaled: bool = False,
        keypoints: bool = False,
    ) -> list[Encoded | Exception]:
        """Encode many frames: each frame, without its pixels, or the error that prevented its encoding.

        Args:
            keep_scaled: retain of each frame the scaled pixels in which keypoints are found.
            keypoints: find them at once.

        Raises:
            EncoderNotInstalled: the encoder is not installed.
        """
        made: dict[int, Encoded | Exception] = {}
        async with aclosing(self.queue.encode_many(identity, frames, deadline, masks, keypoints)) as outcomes:
            async for some in outcomes:
                for index, outcome in some:
                    made[index] = outcome if isinstance(outcome, Exception) else outcome.without_pixels(keep_scaled)
        return [made[index] for index in range(len(frames))]

    def assert_encoder(self, map_: Map, asserted: str | None) -> None:
        """Check that the encoder that a caller names, by name or identity, is the map's.

        Raises:
            WrongEncoder: the map is bound to another encoder.
        """
        identity = map_.record.encoder
        if asserted is None or asserted in (identity, identity.partition("@")[0]):
            return
        raise WrongEncoder(f"The map {map_.record.id} is bound to {identity}, not to {asserted[:140]}.")
