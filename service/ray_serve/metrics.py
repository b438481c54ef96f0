"""Metrics of a front whose encoders are in a Ray cluster."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from service.telemetry.metrics import ITEMS


class CallMetrics:
    """The replicas, and the calls to them."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.replicas = Gauge(
            "placerec_encoder_replicas", "Processes of the Ray cluster that encode.", registry=registry
        )
        self.frames = Histogram(
            "placerec_encoder_call_frames",
            "Frames that were sent to a replica in one call.",
            buckets=ITEMS,
            registry=registry,
        )
        self.lost = Counter(
            "placerec_encoder_calls_lost",
            "Calls whose replica ended or did not answer; their frames were sent again.",
            registry=registry,
        )
