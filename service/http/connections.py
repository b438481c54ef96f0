"""All open connections: how many there may be, who has to go when there are too many, how long each step may take."""

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
from service.settings import Settings
from service.telemetry.metrics import Metrics

LEAST_PROGRESS = 64 * 1024
"""Bytes that a slow caller has to take within each ``write_timeout``."""

MOST_SURPLUS = 64
"""Connections over the limit that are told so; any further ones are closed without a word."""


class Connection(Protocol):
    """What the register knows of a connection."""

    def give_way(self) -> None:
        """Close, for others want the place; called while no request is under way."""


class Connections:
    """The register of connections, used from the event loop alone.

    Args:
        settings: the limits.
        memory: where the bytes that arrive over WebSockets are counted.
    """

    def __init__(self, settings: Settings, memory: UploadMemory, metrics: Metrics) -> None:
        self.settings, self.memory = settings, memory
        self.draining = False
        """Whether each answer is to be the last one of its connection."""
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
        """Connections that are served."""
        return len(self._open)

    @property
    def waiting(self) -> int:
        """Those without a request under way."""
        return len(self._waiting)

    @property
    def streams(self) -> int:
        """WebSockets."""
        return len(self._streams)

    def ended(self, reason: str) -> None:
        """Count a connection that is ended; the reasons are words of ours, never a caller's."""
        self._ended.labels(reason).inc()

    def admit(self, connection: Connection, address: str) -> str | None:
        """Take a new connection in, which waits for its first request.

        Where there are too many, that which has waited longest for a request makes room: one whose caller is slow to
        send, or has nothing to send.

        Returns:
            None; or why it is not served: "surplus", or "flood" where not even that can be told.
        """
        settings = self.settings
        most = settings.max_connections_per_address
        if most and self._of_address[address] >= most and not self._make_room(address):
            return self._refuse(connection)
        if len(self._open) >= settings.max_connections and not self._make_room(None):
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
        """The connection has no request under way any more."""
        if connection in self._open:
            self._waiting[connection] = None

    def work(self, connection: Connection) -> None:
        """The connection has a request under way."""
        self._waiting.pop(connection, None)

    def stream(self, stream: object) -> None:
        """A WebSocket was opened."""
        self._streams.add(stream)

    def leave(self, connection: Connection, stream: object = None) -> None:
        """The connection is gone; more than once does nothing."""
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
    """Bytes that were written and that the other end has not taken: those that wait here, and in the system's buffer.

    The latter goes down bit by bit where the former does in pieces of up to megabytes.
    """
    size = transport.get_write_buffer_size()
    if sys.platform.startswith("linux"):
        descriptor = transport.get_extra_info("socket").fileno()
        size += struct.unpack("i", fcntl.ioctl(descriptor, termios.TIOCOUTQ, bytes(4)))[0]
    return size
