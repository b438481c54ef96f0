"""The key that a command sends: from ``--key``, which every command with ``--url`` has, or from PLACEREC_KEY."""

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
    if value and not TOKEN.fullmatch(value.strip()):  # the message does not repeat the value
        raise typer.BadParameter("a key has the form placerec_…")
    _given.set(value.strip() if value else None)
    return value


Key = Annotated[
    str | None,
    typer.Option(
        "--key",
        envvar=VARIABLE,
        callback=_take,
        expose_value=False,
        help=f"Key to send with --url. Better set {VARIABLE}: other users can see the arguments of a command.",
    ),
]


@cache
def _option() -> object:
    """The option as an object of the command-line library."""
    maker = typer.Typer()

    @maker.command()
    def take(key: Key = None) -> None:
        """Never called; expose_value keeps the key out of the parameters."""

    return next(option for option in typer.main.get_command(maker).params if option.name == "key")


def add_key(command: Any) -> None:
    """Add ``--key`` to a command that has ``--url``."""
    names = {parameter.name for parameter in command.params}
    if "url" in names and "key" not in names:
        command.params.append(_option())


def given_key() -> str | None:
    """The key that the running command was given; None without one."""
    return _given.get()


def is_unencrypted(url: str) -> bool:
    """Whether others on the network could read what is sent to a URL: it is not local and has no TLS."""
    parts = urlsplit(url)
    return parts.scheme == "http" and not _LOOPBACK.fullmatch(parts.hostname or "")
