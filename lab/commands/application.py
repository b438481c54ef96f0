"""The laboratory's commands, as the command line adds them to its own."""

from __future__ import annotations

import typer

from lab.commands.evaluation.evaluate import evaluate
from lab.commands.model import model
from lab.commands.vocabulary import vocabulary


def add_commands(application: typer.Typer) -> None:
    """Add ``evaluate``, ``model`` and ``vocabulary``."""
    application.command()(evaluate)
    application.add_typer(vocabulary, name="vocabulary")
    application.add_typer(model, name="model")
