"""``placerec serve``: run the service."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands.console import Commands, Failure
from service.commands.options.settings import read_settings

if TYPE_CHECKING:
    from service.settings import Settings


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on; default: PLACEREC_HOST.")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port; 0 takes a free one; default: PLACEREC_PORT.")
    ] = None,
    data_dir: Annotated[Path | None, typer.Option("--data-dir", help="Directory of the maps.")] = None,
) -> None:
    """Run the service in the foreground until it is interrupted or terminated.

    All other settings come from the environment; placerec settings lists them. Logs go to standard error, one JSON
    object a line.
    """
    given = {"host": host, "port": port}
    settings = read_settings(data_dir).model_copy(
        update={name: value for name, value in given.items() if value is not None}
    )
    _serve(settings)


alone = typer.Typer(cls=Commands, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
"""The command line with this command and no other; it is read as the whole one would read it."""

alone.callback()(lambda: None)
alone.command()(serve)


def _serve(settings: Settings) -> None:
    from service.telemetry.native_output import logged_stderr

    with logged_stderr():
        _serve_logged(settings)


def _serve_logged(settings: Settings) -> None:
    gc.disable()
    from service.app.application import create_app
    from service.http.connections import Connections
    from service.http.server import CannotListen, serve_application
    from service.open_files import raise_limit
    from service.settings import SettingsError
    from service.telemetry.requests import configure_logging

    gc.freeze()  # all of it lives as long as the process, so the garbage collector need not go through it
    gc.enable()
    configure_logging(settings.log_level)
    raise_limit(settings)
    try:
        application = create_app(settings)
    except SettingsError as error:
        raise Failure(str(error)) from error
    connections = Connections(settings, application.state.upload_memory, application.state.metrics)

    def drain() -> None:
        application.state.runtime.stopping = connections.draining = True

    def stop() -> None:
        application.state.jobs.stop_soon()
        application.state.engine.events.stop_soon()

    try:
        serve_application(
            application,
            settings,
            connections,
            lifespan=lambda: application.router.lifespan_context(application),
            on_signal=drain,
            on_stop=stop,
        )
    except CannotListen as error:
        raise Failure(str(error)) from error
