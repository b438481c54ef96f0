"""The key that a command sends: ``--key`` of every command that takes ``--url``, or PLACEREC_KEY."""

from __future__ import annotations

import re
from contextvars import ContextVar
from functools import cache
from typing import Annotated, Any
from urllib.parse import urlsplit

import typer

from service.access.roles import TOKEN

VARIABLE = "PLACEREC_KEY"
_LOOPBACK = re.compile(r"localhost|.*\.localhost|127\.[0-9.]+|::1")

_given: ContextVar[str | None] = ContextVar("key", default=None)


def _take(value: str | None) -> str | None:
    if value and not TOKEN.fullmatch(value.strip()):  # and do not repeat it
        raise typer.BadParameter("it is not a key of the form placerec_…")
    _given.set(value.strip() if value else None)
    return value


Key = Annotated[
    str | None,
    typer.Option(
        "--key",
        envvar=VARIABLE,
        callback=_take,
        expose_value=False,
        help=f"With --url: the key to send. Better in {VARIABLE}: the words of a command can be seen by other users.",
    ),
]


@cache
def _option() -> object:
    """The option as typer makes it."""
    maker = typer.Typer()

    @maker.command()
    def take(key: Key = None) -> None:
        """Never run: expose_value keeps the key out of the parameters."""

    return next(option for option in typer.main.get_command(maker).params if option.name == "key")


def add_key(command: Any) -> None:
    """Let a command that talks to a service take a key; any other stays as it is."""
    names = {parameter.name for parameter in command.params}
    if "url" in names and "key" not in names:
        command.params.append(_option())


def given_key() -> str | None:
    """The key of the command that runs; None without one."""
    return _given.get()


def headers_for(key: str | None) -> dict[str, str]:
    """The header that carries a key; a key travels in no other way."""
    return {} if key is None else {"Authorization": f"Bearer {key}"}


def travels_openly(url: str) -> bool:
    """Whether what is sent to a URL can be read on its way: over a network, without TLS."""
    parts = urlsplit(url)
    return parts.scheme == "http" and not _LOOPBACK.fullmatch(parts.hostname or "")
