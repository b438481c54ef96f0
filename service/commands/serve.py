"""``placerec serve``: run the service."""

from __future__ import annotations

import asyncio
import math
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.client import read_settings
from service.commands.console import Failure

if TYPE_CHECKING:
    from service.settings import Settings

KEEP_ALIVE_SECONDS = 75
"""A robot that sends a frame now and then keeps its connection."""

STOP_POLL_SECONDS = 0.1


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
    import uvicorn

    from service.app import create_app
    from service.settings import SettingsError
    from service.telemetry import configure_logging

    configure_logging(settings.log_level)
    try:
        application = create_app(settings)
    except SettingsError as error:
        raise Failure(str(error)) from error
    config = uvicorn.Config(
        application,
        host=settings.host.strip("[]"),
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        ws="websockets-sansio",
        ws_max_size=settings.max_image_bytes,
        ws_per_message_deflate=False,  # frames are compressed already
        lifespan="off",  # kept by _run, so that an error at the start ends in its sentence
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=math.ceil(settings.shutdown_timeout),
    )
    try:
        socket = config.bind_socket()
    except SystemExit as error:
        raise Failure(f"Port {settings.port} of {settings.host} cannot be had: is another service there?") from error
    with asyncio.Runner(loop_factory=config.get_loop_factory()) as runner, socket:
        runner.run(_run(application, uvicorn.Server(config), socket))


async def _run(application: Any, server: Any, socket: Any) -> None:
    async with application.router.lifespan_context(application):
        # The server stops at these signals, then sends them again to whoever handled them before:
        # without handlers of ours the process would end there, and not close its maps.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        watch = asyncio.create_task(_stop_early(application.state.engine, server))
        try:
            await server.serve(sockets=[socket])
        finally:
            watch.cancel()


async def _stop_early(engine: Any, server: Any) -> None:
    """Tell jobs, and those who follow them, when the server begins to stop: it waits for them, but not for ever."""
    while not server.should_exit:
        await asyncio.sleep(STOP_POLL_SECONDS)
    engine.jobs.stop_soon()
