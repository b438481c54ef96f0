"""What is read from the engine when Prometheus asks: how full each bounded thing is, and how maps are searched."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, get_args

from anyio import CapacityLimiter
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from core.errors import PlacerecError
from core.storage.search.tiers import Tier
from service.jobs.records import JobState

if TYPE_CHECKING:
    from service.engine.engine import Engine
    from service.http.bodies import UploadMemory


class EngineCollector(Collector):
    """Gauges of the engine.

    Args:
        uploads: the memory of request bodies.
        threads: of the storage.
    """

    def __init__(self, engine: Engine, uploads: UploadMemory, threads: CapacityLimiter) -> None:
        self._engine, self._uploads, self._threads = engine, uploads, threads

    def collect(self) -> Iterable[Metric]:
        engine = self._engine
        yield _gauge("placerec_upload_bytes", "Bytes of request bodies that are held.", self._uploads.held)
        busy, waiting = self._threads.borrowed_tokens, self._threads.statistics().tasks_waiting
        yield _gauge("placerec_storage_threads", "Threads that may search, read or write.", self._threads.total_tokens)
        yield _gauge("placerec_storage_threads_busy", "Threads that do.", busy)
        yield _gauge("placerec_storage_threads_waited_for", "Requests that wait for such a thread.", waiting)
        yield _gauge("placerec_sessions", "Sessions that are under way.", engine.sessions.count())
        yield _gauge("placerec_job_watchers", "Clients that follow jobs.", engine.jobs.watchers)
        yield self._jobs()
        yield from self._maps()
        with suppress(OSError):
            usage = shutil.disk_usage(engine.settings.data_dir)
            yield _gauge("placerec_disk_free_bytes", "Free bytes of the disk of the data directory.", usage.free)
            yield _gauge("placerec_disk_bytes", "All bytes of that disk.", usage.total)
        yield _gauge("placerec_stopping", "1 while the service is about to stop.", int(engine.stopping))

    def _jobs(self) -> Metric:
        counts = Counter(job.state for job in self._engine.jobs.all())
        gauge = GaugeMetricFamily("placerec_jobs", "Jobs that are remembered, by their state.", labels=["state"])
        for state in get_args(JobState):
            gauge.add_metric([state], counts[state])
        return gauge

    def _maps(self) -> Iterable[Metric]:
        """By tier, for a name of each map would be one more series for every map."""
        tiers, building, open_ = Counter[str](), 0, 0
        for record in self._engine.all_records():
            with suppress(PlacerecError):  # deleted, or found to be damaged, since it was listed
                map_ = self._engine.atlas.find(record.id)
                if map_.is_open:
                    status = map_.index_status()
                    open_ += 1
                    tiers[status.tier] += 1
                    building += status.state == "building"
        gauge = GaugeMetricFamily("placerec_maps_searched", "Open maps, by how they are searched.", labels=["tier"])
        for tier in get_args(Tier):
            gauge.add_metric([tier], tiers[tier])
        yield gauge
        yield _gauge("placerec_indexes_building", "Open maps whose index is being built.", building)
        yield _gauge("placerec_maps_open", "Maps that are open: the others are opened by their first query.", open_)


@contextmanager
def gauges(engine: Engine, uploads: UploadMemory, threads: CapacityLimiter) -> Iterator[None]:
    """Within, they are among the metrics of the engine."""
    collector = EngineCollector(engine, uploads, threads)
    engine.metrics.registry.register(collector)
    try:
        yield
    finally:
        engine.metrics.registry.unregister(collector)


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)
