"""Metrics for Prometheus: requests, the queue, stages of encoding, searches, and the answers of each map."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from core.judgement.verdict import Verdict
from service.telemetry.history import LoadHistory
from service.telemetry.latencies import RecentLatencies

FAST = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5)
SECONDS = (*FAST, 5.0, 10.0, 30.0)
SCORES = tuple(round(0.05 * step, 2) for step in range(-2, 21))
ITEMS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)


MOST_MAPS = 100
"""Maps that have series of their own; the others are counted together."""

MOST_REQUEST_SERIES = 200
"""Routes, methods and statuses that have a series of their own; the others are counted by their status alone."""

OTHERS = "_others"
"""The label of what is counted together; no map and no route is called so."""


class MapCollector(Collector):
    """Gauges that are read from the maps when Prometheus asks.

    Args:
        count_places: returns the number of places of each map.
        count_quarantined: returns the number of maps that are out of service.
    """

    def __init__(self, count_places: Callable[[], Mapping[str, int]], count_quarantined: Callable[[], int]) -> None:
        self._count_places, self._count_quarantined = count_places, count_quarantined

    def collect(self) -> Iterable[Metric]:
        places = GaugeMetricFamily("placerec_map_places", "Places of a map.", labels=["map"])
        counts = sorted(self._count_places().items(), key=lambda one: (-one[1], one[0]))
        for name, count in counts[:MOST_MAPS]:
            places.add_metric([name], count)
        if len(counts) > MOST_MAPS:
            places.add_metric([OTHERS], sum(count for _, count in counts[MOST_MAPS:]))
        yield places
        quarantined = GaugeMetricFamily("placerec_quarantined_maps", "Maps that are damaged and out of service.")
        quarantined.add_metric([], self._count_quarantined())
        yield quarantined


class Metrics:
    """The metrics of one application, in a registry of its own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry(auto_describe=False)
        self._requests: dict[tuple[str, str, int], Histogram] = {}
        self._maps: set[str] = set()  # with series of their own
        self._stages: dict[str, Histogram] = {}
        self._verdicts: dict[tuple[str, str], Counter] = {}
        self._scores: dict[str, Histogram] = {}
        self.latencies = RecentLatencies()
        self.history: LoadHistory | None = None
        ProcessCollector(registry=self.registry)
        self.requests = Histogram(
            "placerec_request_seconds",
            "Time from a request's arrival to the end of its answer.",
            ["route", "method", "status"],
            buckets=SECONDS,
            registry=self.registry,
        )
        self.queue = Gauge(
            "placerec_queue_length", "Requests that wait for the encoder or are in it.", registry=self.registry
        )
        self.under_way = Gauge(
            "placerec_requests_under_way", "Requests and WebSockets that are being answered.", registry=self.registry
        )
        self.commits = Histogram(
            "placerec_commit_seconds",
            "Time of one commit of enrolled frames, until all of it is synced to the disk.",
            buckets=SECONDS,
            registry=self.registry,
        )
        self.problems = Counter(
            "placerec_problems", "Requests that ended in a problem, by its type.", ["type"], registry=self.registry
        )
        self.stages = Histogram(
            "placerec_encode_stage_seconds",
            "Time of one stage of encoding a frame.",
            ["stage"],
            buckets=FAST,
            registry=self.registry,
        )
        self.searches = Histogram(
            "placerec_search_seconds", "Time of a search in one map.", buckets=FAST, registry=self.registry
        )
        self.batches = Histogram(
            "placerec_batch_items",
            "Frames in one multipart request.",
            ["operation"],
            buckets=ITEMS,
            registry=self.registry,
        )
        self.scores = Histogram(
            "placerec_best_score", "Best score of a query.", ["map"], buckets=SCORES, registry=self.registry
        )
        self.contradicted = Counter(
            "placerec_contradicted_frames",
            "Frames of sessions whose odometry contradicts what frames show, by what it looks like.",
            ["kind"],
            registry=self.registry,
        )
        self.verdicts = Counter(
            "placerec_verdicts", "Queries by their verdict.", ["map", "verdict"], registry=self.registry
        )

    def observe_request(
        self, route: str, method: str, status: int, seconds: float, *, by_console: bool = False
    ) -> None:
        """Count a request and its duration; those of the console itself are not what its operator asks after."""
        if not by_console:
            self.latencies.observe(method, route, status, seconds)
            if self.history is not None:
                self.history.observe_request(route, status, seconds)
        key = (route, method, status)
        if key not in self._requests and len(self._requests) >= MOST_REQUEST_SERIES:
            key = (OTHERS, OTHERS, status)
        if key not in self._requests:  # looking up a series costs more than counting in it
            self._requests[key] = self.requests.labels(key[0], key[1], str(status))
        self._requests[key].observe(seconds)

    def requests_under_way(self) -> float:
        """The number of requests and WebSockets that are being answered."""
        return next(iter(self.under_way.collect())).samples[0].value

    def observe_stages(self, milliseconds: Mapping[str, float]) -> None:
        """Count the durations of the stages of an encoding."""
        for stage, duration in milliseconds.items():
            if stage not in self._stages:
                self._stages[stage] = self.stages.labels(stage)
            self._stages[stage].observe(duration / 1e3)

    def observe_answer(self, map_id: str, verdict: str, score: float | None) -> None:
        """Count the answer to a query."""
        if self.history is not None:
            self.history.observe_answer(verdict)
        if map_id not in self._maps:
            if len(self._maps) < MOST_MAPS:
                self._maps.add(map_id)
            else:
                map_id = OTHERS
        key = (map_id, verdict)
        if key not in self._verdicts:
            self._verdicts[key] = self.verdicts.labels(map_id, verdict)
        self._verdicts[key].inc()
        if score is not None:
            if map_id not in self._scores:
                self._scores[map_id] = self.scores.labels(map_id)
            self._scores[map_id].observe(score)

    def forget_map(self, map_id: str) -> None:
        """Drop the series of a deleted map."""
        self._maps.discard(map_id)
        self._scores.pop(map_id, None)
        with suppress(KeyError):
            self.scores.remove(map_id)
        for verdict in get_args(Verdict):
            self._verdicts.pop((map_id, verdict), None)
            with suppress(KeyError):
                self.verdicts.remove(map_id, verdict)

    def expose(self) -> bytes:
        """All metrics in the text format of Prometheus."""
        return generate_latest(self.registry)
