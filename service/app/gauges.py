"""Gauges that are computed when Prometheus reads them: how full each bounded resource is, how maps are searched."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import get_args

from anyio import CapacityLimiter, to_thread
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from core.errors import PlacerecError
from core.maps import MapRecord
from core.maps.status import Tier
from service.app.runtime import Runtime
from service.http.bodies import UploadMemory
from service.jobs.job import JobState
from service.worker_threads import ThreadTurns, thread_turns


class RuntimeCollector(Collector):
    """Collects the gauges of a running application.

    Args:
        uploads: the memory that request bodies occupy.
        threads: the limiter of the threads for storage.
        turns: the turns of callers at these threads.
    """

    def __init__(self, runtime: Runtime, uploads: UploadMemory, threads: CapacityLimiter, turns: ThreadTurns) -> None:
        self._runtime, self._uploads, self._threads, self._turns = runtime, uploads, threads, turns

    def collect(self) -> Iterable[Metric]:
        runtime = self._runtime
        yield _gauge("placerec_upload_bytes", "Bytes of request bodies held in memory.", self._uploads.held)
        busy = self._threads.borrowed_tokens
        waiting = self._threads.statistics().tasks_waiting + self._turns.waiting
        yield _gauge(
            "placerec_storage_threads", "Threads that may search, read or write maps.", self._threads.total_tokens
        )
        yield _gauge("placerec_storage_threads_busy", "Storage threads that are busy.", busy)
        yield _gauge("placerec_storage_threads_waited_for", "Requests that wait for a storage thread.", waiting)
        yield _gauge("placerec_sessions", "Open sessions.", runtime.sessions.count())
        yield _gauge("placerec_job_watchers", "Clients that follow jobs.", len(runtime.jobs.watchers))
        listeners = runtime.engine.events.listeners
        yield _gauge("placerec_event_listeners", "Clients that listen to the events of maps.", listeners)
        dropped = runtime.engine.review_keeper.dropped
        yield _gauge("placerec_review_frames_dropped", "Frames for review that were not stored.", dropped)
        if (moment := runtime.backups.newest()) is not None:
            text = "When the newest backup was begun, in seconds since 1970."
            yield _gauge("placerec_last_backup_timestamp_seconds", text, moment.timestamp())
        yield self._jobs()
        yield from self._maps()
        with suppress(OSError):
            usage = shutil.disk_usage(runtime.settings.data_dir)
            yield _gauge("placerec_disk_free_bytes", "Free bytes on the disk of the data directory.", usage.free)
            yield _gauge("placerec_disk_bytes", "Size of the disk of the data directory in bytes.", usage.total)
        yield _gauge(
            "placerec_degraded", "1 if the service takes no writes for want of room, else 0.", int(runtime.degraded)
        )
        yield _gauge("placerec_stopping", "1 if the service is about to stop, else 0.", int(runtime.stopping))

    def _jobs(self) -> Metric:
        counts = self._runtime.jobs.counts()
        gauge = GaugeMetricFamily(
            "placerec_jobs", "Jobs, by state, including ended ones that are still listed.", labels=["state"]
        )
        for state in get_args(JobState):
            gauge.add_metric([state], counts[state])
        return gauge

    def _maps(self) -> Iterable[Metric]:
        """Counts by tier; a label with the name of each map would make too many series."""
        tiers = Counter[str]()
        records: list[MapRecord] = []
        with suppress(PlacerecError):
            records = self._runtime.engine.all_records()
        for record in records:
            with suppress(PlacerecError):  # it was deleted or found to be damaged since it was listed
                map_ = self._runtime.engine.maps.find(record.id)
                if map_.is_open:
                    tiers[map_.index_status().tier] += 1
        gauge = GaugeMetricFamily(
            "placerec_maps_searched", "Open maps, by the tier in which they are searched.", labels=["tier"]
        )
        for tier in get_args(Tier):
            gauge.add_metric([tier], tiers[tier])
        yield gauge
        engine = self._runtime.engine
        yield _gauge("placerec_maps_open", "Open maps; a map is opened when it is used.", engine.maps.open_maps)
        yield _gauge("placerec_maps_open_limit", "Maps that may be open at the same time.", engine.most_open_maps)


@contextmanager
def gauges(runtime: Runtime, uploads: UploadMemory) -> Iterator[None]:
    """Add these gauges to the metrics while the block runs, on the event loop whose threads they count."""
    threads = to_thread.current_default_thread_limiter()
    collector = RuntimeCollector(runtime, uploads, threads, thread_turns())
    runtime.engine.metrics.registry.register(collector)
    try:
        yield
    finally:
        runtime.engine.metrics.registry.unregister(collector)


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)
