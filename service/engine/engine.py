"""What lives as long as the process: the maps, the encoders, the queue, the counters."""

from __future__ import annotations

import asyncio
import gc
import logging
import time
from collections.abc import AsyncGenerator, Iterator, Sequence
from contextlib import aclosing, contextmanager, suppress

from anyio import to_thread

from core.errors import MapQuarantined, PlacerecError, UnknownEncoder, UnknownMap, WrongEncoder
from core.frames.images import Limits
from core.frames.masks import Mask
from core.index.exact import compile_ahead
from core.judgement.verdict import Calibration
from core.method.catalogue import EncoderCatalogue
from core.storage import Atlas, Map, MapRecord
from service.engine.map_locks import Possession
from service.engine.queue import Encoded, Inference, Outcomes, Patience, Then
from service.engine.searches import Searches
from service.errors.faults import EncoderNotInstalled, NotReady
from service.jobs.jobs import Jobs
from service.maps.exports import Exports
from service.maps.imports import Imports
from service.places.batch_order import Succession
from service.places.staging import Staging
from service.queries.pictures import Pictures
from service.sessions.sessions import Sessions
from service.settings import Settings, unknown_variables
from service.telemetry.metrics import MapCollector, Metrics
from service.upkeep.upkeep import Upkeep
from service.worker_threads import in_thread as in_thread

DISK_CHECK_SECONDS = 1.0
"""A readiness probe that comes sooner is told the last result."""

log = logging.getLogger("placerec.engine")


async def camera_mask(map_: Map, camera: str | None) -> Mask | None:
    """What to ignore in a frame of one of a map's cameras; nothing if none is named.

    Raises:
        UnknownCamera: the map has none of this name.
    """
    return None if camera is None else await in_thread(map_.cameras.mask, camera)


class Engine:
    """Everything that the routes work with.

    Raises:
        DataDirectoryLocked, DataDirectoryTooNew, StorageFailure: the data directory cannot be had.
    """

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self.settings, self.metrics = settings, metrics
        self.atlas = Atlas(settings.data_dir)
        self.catalogue = EncoderCatalogue(settings.models_directory, settings.precision, settings.device)
        limits = Limits(max_bytes=settings.max_image_bytes, max_pixels=settings.max_image_pixels)
        self.inference = Inference(self.catalogue, limits, settings.queue_length, settings.threads, metrics)
        try:
            self.jobs = Jobs(
                settings.data_dir,
                settings.job_workers,
                settings.job_queue,
                settings.job_history,
                settings.job_watchers,
            )
        except BaseException:
            self.inference.close()
            self.atlas.close()
            raise
        try:
            self.sessions = Sessions(settings)
        except BaseException:
            self.jobs.close(0.0)
            self.inference.close()
            self.atlas.close()
            raise
        self.searches = Searches()
        self.succession = Succession()
        self.staging = Staging(settings.data_dir, settings.max_staged_bytes)
        self.upkeep = Upkeep(self)
        self.exports, self.imports = Exports(settings), Imports(self)
        self._possession = Possession()
        self.pictures = Pictures()
        self.stopping = False
        """Whether the service is about to stop, so that nobody should be sent here any more."""
        self._encoder_state = "loading"
        self._disk_state, self._disk_checked = "ok", 0.0
        self._loading: asyncio.Task[None] | None = None
        self._map_collector = MapCollector(self._count_places, lambda: len(self.atlas.quarantined()))
        metrics.registry.register(self._map_collector)

    def start(self) -> None:
        """Begin to load the default encoder; liveness is answered meanwhile."""
        for name in unknown_variables():
            log.warning("the environment sets %s, which is no setting", name)
        self._loading = asyncio.create_task(self._load_default())
        self.loop = asyncio.get_running_loop()
        self.upkeep.start()
        self.exports.clean()
        self.imports.clean()
        self.jobs.start()

    async def close(self) -> None:
        """Finish what runs and give the data directory back."""
        if self._loading is not None:
            self._loading.cancel()
        self.metrics.registry.unregister(self._map_collector)
        await self.exports.close()
        # Jobs first: what they are at needs the encoder and the maps.
        await to_thread.run_sync(self.jobs.close, self.settings.shutdown_timeout)
        await to_thread.run_sync(self.upkeep.close)
        await to_thread.run_sync(self.inference.close)
        await to_thread.run_sync(self.sessions.close)
        await to_thread.run_sync(self.atlas.close)

    async def _load_default(self) -> None:
        began = time.perf_counter()
        try:
            identity = await in_thread(self.catalogue.resolve, self.settings.encoder)
            await self.inference.load(identity)
            await in_thread(compile_ahead)
        except PlacerecError as error:
            self._encoder_state = str(error)
            log.error("the default encoder cannot be used: %s", error)
        except Exception:
            self._encoder_state = "it cannot be loaded; the log says why"
            log.exception("the default encoder cannot be loaded")
        else:
            # What is loaded by now stays: the collector need not walk over it again and again, which takes long.
            gc.collect()
            gc.freeze()
            self._encoder_state = "ok"
            log.info("ready", extra={"encoder": identity, "seconds": round(time.perf_counter() - began, 2)})

    async def check_readiness(self) -> dict[str, str]:
        """The outcome of each check, all of them "ok".

        Raises:
            NotReady: at least one is not.
        """
        now = time.monotonic()
        if now - self._disk_checked > DISK_CHECK_SECONDS:
            self._disk_checked = now
            self._disk_state = await in_thread(self._check_disk)
        checks = {"encoder": self._encoder_state, "maps": "ok", "disk": self._disk_state}
        if self.stopping:
            checks["service"] = "it is stopping"
        bad = [f"{name}: {state}" for name, state in checks.items() if state != "ok"]
        if bad:
            raise NotReady(f"Not ready: {'; '.join(bad)}", checks)
        return checks

    def _check_disk(self) -> str:
        try:
            self.atlas.check_writable()
        except PlacerecError as error:
            return str(error)
        return "ok"

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
        """Possession of a map for a write that depends on a look at it; blocks, so call it in a thread."""
        with self._possession.of(map_id):
            yield

    # Encoders

    def default_calibration(self, identity: str) -> Calibration | None:
        """What an encoder ships with; None if it is not installed."""
        for summary in self.catalogue.describe():
            if summary.identity == identity:
                return summary.calibration
        return None

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
        patience: Patience,
        mask: Mask | None = None,
        then: Then | None = None,
    ) -> Encoded:
        """Encode a frame with a map's encoder; call it within ``inference.place_in_queue``.

        Raises:
            EncoderNotInstalled: the map's encoder is not here (any more).
            Others: as for ``Inference.encode``.
        """
        try:
            return await self.inference.encode(map_.record.encoder, data, patience, mask, then)
        except UnknownEncoder as error:
            raise EncoderNotInstalled(str(error)) from error

    async def encode_many_for(
        self, map_: Map, frames: Sequence[bytes], patience: Patience, masks: Sequence[Mask | None] | None = None
    ) -> AsyncGenerator[Outcomes]:
        """The same for many frames, as ``Inference.encode_many`` yields them; close it, as ``aclosing`` does."""
        async with aclosing(self.inference.encode_many(map_.record.encoder, frames, patience, masks)) as outcomes:
            async for some in outcomes:
                for _, outcome in some:
                    if isinstance(outcome, UnknownEncoder):
                        raise EncoderNotInstalled(str(outcome)) from outcome
                yield some

    async def encode_all_for(
        self, map_: Map, frames: Sequence[bytes], patience: Patience, masks: Sequence[Mask | None] | None = None
    ) -> list[Encoded | Exception]:
        """What became of each frame, in their order; the pixels, which would fill the memory, are not kept."""
        made: dict[int, Encoded | Exception] = {}
        async with aclosing(self.encode_many_for(map_, frames, patience, masks)) as outcomes:
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
