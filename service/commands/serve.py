"""``placerec serve``: run the service."""

from __future__ import annotations

import asyncio
import functools
import math
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.connection.client import read_settings
from service.commands.console import Failure

if TYPE_CHECKING:
    from service.settings import Settings

SPARE_FILES = 1024
"""Files open besides the connections: those of the maps above all."""


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on; else PLACEREC_HOST.")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = None,
    data_dir: Annotated[Path | None, typer.Option("--data-dir", help="Directory of the maps.")] = None,
) -> None:
    """Run the service in the foreground until it is interrupted or terminated.

    Everything else is set in the environment: see placerec settings. Logs go to standard error, one JSON object a
    line.
    """
    given = {"host": host, "port": port}
    settings = read_settings(data_dir).model_copy(
        update={name: value for name, value in given.items() if value is not None}
    )
    _serve(settings)


def _serve(settings: Settings) -> None:
    from service.telemetry.native_output import logged_stderr

    with logged_stderr():
        _serve_logged(settings)


def _serve_logged(settings: Settings) -> None:
    import uvicorn

    from service.app.application import create_app
    from service.http.connections import Connections, patient
    from service.http.protocol import HttpConnection
    from service.http.websocket_protocol import StreamConnection
    from service.settings import SettingsError
    from service.telemetry.requests import configure_logging

    configure_logging(settings.log_level)
    try:
        application = create_app(settings)
    except SettingsError as error:
        raise Failure(str(error)) from error
    connections = Connections(settings, application.state.upload_memory, application.state.metrics)
    protocols: dict[str, Any] = {
        "http": functools.partial(HttpConnection, connections=connections),
        "ws": functools.partial(StreamConnection, connections=connections),
    }
    config = uvicorn.Config(
        application,
        host=settings.host.strip("[]"),
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        ws_max_size=settings.max_image_bytes,
        ws_per_message_deflate=False,  # frames are compressed already
        lifespan="off",  # kept by _run, so that an error at the start ends in its sentence
        timeout_keep_alive=math.ceil(settings.keep_alive_timeout),
        timeout_graceful_shutdown=math.ceil(settings.shutdown_timeout),
        **protocols,
    )
    try:
        socket = config.bind_socket()
    except SystemExit as error:
        raise Failure(f"Port {settings.port} of {settings.host} cannot be had: is another service there?") from error
    patient(socket, settings)
    raise_file_limit(settings.max_connections)
    with asyncio.Runner(loop_factory=config.get_loop_factory()) as runner, socket:
        runner.run(_run(application, config, socket, settings, connections))


async def _run(application: Any, config: Any, socket: Any, settings: Settings, connections: Any) -> None:
    from service.http.server import DrainingServer

    def drain() -> None:
        application.state.runtime.stopping = connections.draining = True

    async with application.router.lifespan_context(application):
        # The server stops at these signals, then sends them again to whoever handled them before:
        # without handlers of ours the process would end there, and not close its maps.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        stop_jobs = application.state.jobs.stop_soon
        server = DrainingServer(config, settings.drain_seconds, drain, stop_jobs)
        await server.serve(sockets=[socket])


def raise_file_limit(connections: int) -> None:
    """Ask the system for as many open files as the connections and the maps may need; warn if it refuses."""
    import logging
    import resource

    wanted = connections + SPARE_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
        soft = most
    if soft != resource.RLIM_INFINITY and soft < wanted:
        log = logging.getLogger("placerec.server")
        log.warning("the system allows %d open files; %d connections and the maps want %d", soft, connections, wanted)
