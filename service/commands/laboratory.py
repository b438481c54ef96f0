"""The commands of the laboratory, which are there where it is installed: ``pip install 'placerec[lab]'``."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec

import typer

from service.commands.console import Failure

COMMANDS = ("evaluate", "model", "vocabulary")
NEEDED = ("lab", "jinja2", "matplotlib")
"""The laboratory and the packages of its extra."""

ANYTHING = {"allow_extra_args": True, "ignore_unknown_options": True}


def add_laboratory(application: typer.Typer) -> None:
    """Add the laboratory's commands; where it is not installed, they say how to get it and are not listed."""
    if is_installed():
        import_module("lab.commands.application").add_commands(application)
        return
    for name in COMMANDS:
        application.command(name, add_help_option=False, context_settings=ANYTHING, hidden=True)(_missing(name))


def is_installed() -> bool:
    """Whether the laboratory and what its extra brings can be imported."""
    try:
        return all(find_spec(name) for name in NEEDED)
    except ModuleNotFoundError:  # of an import system that says so itself
        return False


def _missing(name: str) -> Callable[[], None]:
    def refuse() -> None:
        raise Failure(f"`placerec {name}` belongs to the laboratory: pip install 'placerec[lab]'.")

    return refuse
