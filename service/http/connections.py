"""The register of open connections: how many there may be, and which one is closed when there are too many."""

from __future__ import annotations

import asyncio
import fcntl
import struct
import sys
import termios
from collections import Counter, OrderedDict
from collections.abc import Iterable
from typing import Protocol

import prometheus_client
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from service.http.bodies import UploadMemory
from service.open_files import shares_of
from service.settings import Settings
from service.telemetry.metrics import Metrics

LEAST_PROGRESS = 64 * 1024
"""Bytes that a slow client has to read within each ``write_timeout``."""

MOST_SURPLUS = 64
"""Connections over the limit that get an answer; further ones are closed without one."""


class Connection(Protocol):
    """The part of a connection that the register uses."""

    def give_way(self) -> None:
        """Close to make room for another connection; called only while no request is under way."""


class Connections:
    """The register of connections.  It is used only from the event loop.

    Args:
        settings: the limits.
        memory: counts the bytes that arrive over WebSockets.
        metrics: counts the connections.
    """

    def __init__(self, settings: Settings, memory: UploadMemory, metrics: Metrics) -> None:
        self.settings, self.memory = settings, memory
        self._most = shares_of(settings).connections
        self.draining = False
        """Whether a connection is closed after its next answer."""
        self._open: dict[Connection, str] = {}
        self._of_address: Counter[str] = Counter()
        self._waiting: OrderedDict[Connection, None] = OrderedDict()
        self._surplus: set[Connection] = set()
        self._streams: set[object] = set()
        self._ended = prometheus_client.Counter(
            "placerec_connections_ended",
            "Connections that the service ended before their callers did, by the reason.",
            ["reason"],
            registry=metrics.registry,
        )
        metrics.registry.register(_Gauges(self))

    def __len__(self) -> int:
        """The number of connections that are served."""
        return len(self._open)

    @property
    def waiting(self) -> int:
        """The number of connections without a request under way."""
        return len(self._waiting)

    @property
    def streams(self) -> int:
        """The number of open WebSockets."""
        return len(self._streams)

    def ended(self, reason: str) -> None:
        """Count a connection that the service ends; ``reason`` is one of a few fixed words."""
        self._ended.labels(reason).inc()

    def admit(self, connection: Connection, address: str) -> str | None:
        """Register a new connection, which then waits for its first request.

        If there are too many, the connection that has waited longest for a request is closed to make room.

        Returns:
            None if the connection is served; "surplus" if it is to be refused with an answer; "flood" if it is to be
            closed without one.
        """
        most = self.settings.max_connections_per_address
        if most and self._of_address[address] >= most and not self._make_room(address):
            return self._refuse(connection)
        if len(self._open) >= self._most and not self._make_room(None):
            return self._refuse(connection)
        self._open[connection] = address
        self._of_address[address] += 1
        self._waiting[connection] = None
        return None

    def _refuse(self, connection: Connection) -> str:
        if len(self._surplus) >= MOST_SURPLUS:
            return "flood"
        self._surplus.add(connection)
        return "surplus"

    def _make_room(self, address: str | None) -> bool:
        for connection in self._waiting:
            if address is None or self._open[connection] == address:
                self.leave(connection)
                connection.give_way()
                return True
        return False

    def wait(self, connection: Connection) -> None:
        """Note that the connection has no request under way any more."""
        if connection in self._open:
            self._waiting[connection] = None

    def work(self, connection: Connection) -> None:
        """Note that the connection has a request under way."""
        self._waiting.pop(connection, None)

    def stream(self, stream: object) -> None:
        """Note that a WebSocket was opened."""
        self._streams.add(stream)

    def leave(self, connection: Connection, stream: object = None) -> None:
        """Forget a connection that is gone; calling it again does nothing."""
        self._surplus.discard(connection)
        self._streams.discard(stream)
        self._waiting.pop(connection, None)
        address = self._open.pop(connection, None)
        if address is not None:
            self._of_address[address] -= 1
            if not self._of_address[address]:
                del self._of_address[address]


class _Gauges(Collector):
    def __init__(self, connections: Connections) -> None:
        self._connections = connections

    def collect(self) -> Iterable[Metric]:
        gauge = GaugeMetricFamily("placerec_connections", "Open connections, by what they do.", labels=["state"])
        connections = self._connections
        working = len(connections) - connections.waiting - connections.streams
        for state, count in (
            ("waiting", connections.waiting),
            ("working", working),
            ("streaming", connections.streams),
        ):
            gauge.add_metric([state], count)
        yield gauge


def untaken(transport: asyncio.Transport) -> int:
    """The number of written bytes that the client has not acknowledged, in this process and in the system's buffer.

    The system's buffer is included because it shrinks steadily, while ours shrinks in steps of up to megabytes.
    """
    size = transport.get_write_buffer_size()
    if sys.platform.startswith("linux"):
        descriptor = transport.get_extra_info("socket").fileno()
        size += struct.unpack("i", fcntl.ioctl(descriptor, termios.TIOCOUTQ, bytes(4)))[0]
    return size
