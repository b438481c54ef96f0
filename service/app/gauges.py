"""Gauges that are read when Prometheus asks: how full each bounded resource is, and how maps are searched."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import get_args

from anyio import CapacityLimiter
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from core.errors import PlacerecError
from core.storage.search.tiers import Tier
from service.app.runtime import Runtime
from service.http.bodies import UploadMemory
from service.jobs.records import JobState


class RuntimeCollector(Collector):
    """Gauges of what lives while the application runs.

    Args:
        uploads: the memory of request bodies.
        threads: of the storage.
    """

    def __init__(self, runtime: Runtime, uploads: UploadMemory, threads: CapacityLimiter) -> None:
        self._runtime, self._uploads, self._threads = runtime, uploads, threads

    def collect(self) -> Iterable[Metric]:
        runtime = self._runtime
        yield _gauge("placerec_upload_bytes", "Bytes of request bodies that are held.", self._uploads.held)
        busy, waiting = self._threads.borrowed_tokens, self._threads.statistics().tasks_waiting
        yield _gauge("placerec_storage_threads", "Threads that may search, read or write.", self._threads.total_tokens)
        yield _gauge("placerec_storage_threads_busy", "Threads that do.", busy)
        yield _gauge("placerec_storage_threads_waited_for", "Requests that wait for such a thread.", waiting)
        yield _gauge("placerec_sessions", "Sessions that are under way.", runtime.sessions.count())
        yield _gauge("placerec_job_watchers", "Clients that follow jobs.", runtime.jobs.watchers)
        yield self._jobs()
        yield from self._maps()
        with suppress(OSError):
            usage = shutil.disk_usage(runtime.settings.data_dir)
            yield _gauge("placerec_disk_free_bytes", "Free bytes of the disk of the data directory.", usage.free)
            yield _gauge("placerec_disk_bytes", "All bytes of that disk.", usage.total)
        yield _gauge("placerec_stopping", "1 while the service is about to stop.", int(runtime.stopping))

    def _jobs(self) -> Metric:
        counts = Counter(job.state for job in self._runtime.jobs.all())
        gauge = GaugeMetricFamily("placerec_jobs", "Jobs that are remembered, by their state.", labels=["state"])
        for state in get_args(JobState):
            gauge.add_metric([state], counts[state])
        return gauge

    def _maps(self) -> Iterable[Metric]:
        """By tier, for a name of each map would be one more series for every map."""
        tiers, building, open_ = Counter[str](), 0, 0
        for record in self._runtime.engine.all_records():
            with suppress(PlacerecError):  # deleted, or found to be damaged, since it was listed
                map_ = self._runtime.engine.atlas.find(record.id)
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
def gauges(runtime: Runtime, uploads: UploadMemory, threads: CapacityLimiter) -> Iterator[None]:
    """Within, these gauges are among the metrics."""
    collector = RuntimeCollector(runtime, uploads, threads)
    runtime.engine.metrics.registry.register(collector)
    try:
        yield
    finally:
        runtime.engine.metrics.registry.unregister(collector)


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)
