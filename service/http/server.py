"""The server: from the socket that it listens on to the last answer before it stops.

A request comes in over an :class:`~service.http.http_connection.HttpConnection`, which may become a
:class:`~service.http.websocket_connection.WebSocketConnection`.  Both are entered in one register,
:class:`~service.http.connections.Connections`, which limits how many there are.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import math
import os
import signal
import socket
import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from types import FrameType
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from service.http.connections import Connections
from service.http.http_connection import HttpConnection
from service.http.websocket_connection import WebSocketConnection
from service.settings import Settings

LAST_WORD_SECONDS = 1.0
"""How long a request that is cancelled has for its answer, which says so."""

log = logging.getLogger("placerec.server")


class CannotListen(Exception):
    """The address of the settings cannot be listened on."""


def serve_application(
    application: ASGIApp,
    settings: Settings,
    connections: Connections,
    *,
    lifespan: Callable[[], AbstractAsyncContextManager[Any]],
    on_signal: Callable[[], None],
    on_stop: Callable[[], None],
) -> None:
    """Serve an application until the process receives a signal to stop.

    Args:
        application: the ASGI application.
        settings: the address to listen on and the limits.
        connections: the register of connections, with the same settings.
        lifespan: starts the application and, on exit, closes it.
        on_signal: is called at the first signal, while everything is still answered.
        on_stop: is called when nothing new is accepted any more.

    Raises:
        CannotListen: the address cannot be used; the application was not started.
    """
    protocols: dict[str, Any] = {
        "http": functools.partial(HttpConnection, connections=connections),
        "ws": functools.partial(WebSocketConnection, connections=connections),
    }
    config = uvicorn.Config(
        application,
        host=settings.host.strip("[]"),
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers="FORWARDED_ALLOW_IPS" in os.environ,  # whoever calls from this machine is not believed by default
        ws_max_size=settings.max_image_bytes,
        ws_per_message_deflate=False,  # frames are compressed already
        lifespan="off",  # run here, so that an error at the start reaches the caller
        timeout_keep_alive=math.ceil(settings.keep_alive_timeout),
        timeout_graceful_shutdown=math.ceil(settings.shutdown_timeout),
        **protocols,
    )
    try:
        listener = config.bind_socket()
    except SystemExit as error:  # uvicorn has logged why
        message = f"Cannot listen on port {settings.port} of {settings.host}. Is another service running there?"
        raise CannotListen(message) from error
    detect_dead_peers(listener, settings)

    async def run() -> None:
        async with lifespan():
            # The server stops at these signals, then sends them again to the handlers that were set before.  Without
            # these handlers the process would end there, before the application is closed.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: None)
            server = DrainingServer(config, settings.drain_seconds, on_signal, on_stop)
            await server.serve(sockets=[listener])

    with asyncio.Runner(loop_factory=config.get_loop_factory()) as runner, listener:
        runner.run(run())


class DrainingServer(uvicorn.Server):
    """A server that is taken out of service before it stops.

    At the first SIGTERM or SIGINT ``on_signal`` is called, and for ``drain_seconds`` every request is still answered.
    Then ``on_stop`` is called, nothing new is accepted, and the requests under way have the configured time to end.
    A second signal ends the waiting.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        drain_seconds: float,
        on_signal: Callable[[], None],
        on_stop: Callable[[], None],
    ) -> None:
        super().__init__(config)
        self._drain_seconds, self._on_signal, self._on_stop = drain_seconds, on_signal, on_stop
        self._stop_at: float | None = None

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Note a signal.  It interrupts the event loop's thread at any instruction, so it only sets values."""
        self._captured_signals.append(sig)
        if self._stop_at is None:
            self._on_signal()
            self._stop_at = time.monotonic() + self._drain_seconds
        else:
            self._stop_at, self.force_exit = time.monotonic(), True
        self.should_exit = time.monotonic() >= self._stop_at

    async def on_tick(self, counter: int) -> bool:
        """Whether to stop now; uvicorn calls it several times a second."""
        if self._stop_at is not None and time.monotonic() >= self._stop_at:
            self.should_exit = True
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accept nothing new, and give the requests under way their time."""
        self._on_stop()
        await super().shutdown(sockets)
        # A request that is still under way is cancelled, and answered so before the loop ends.
        tasks = [task for task in self.server_state.tasks if not task.done()]
        if tasks:
            log.warning("requests are given up", extra={"requests": len(tasks)})
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks, timeout=LAST_WORD_SECONDS)


def detect_dead_peers(listener: socket.socket, settings: Settings) -> None:
    """Let the system close the connections of a listener whose other end is gone without having closed them."""
    seconds = max(1, round(settings.write_timeout))
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # data was sent and is not acknowledged
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 2000 * seconds)
    if hasattr(socket, "TCP_KEEPIDLE"):  # the connection is idle
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, max(1, seconds))
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, max(1, seconds // 3))
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
