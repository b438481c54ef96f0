"""The settings of a command: those of the environment, with the options that stand for one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from service.commands.console import Failure

if TYPE_CHECKING:
    from service.settings import Settings


def read_settings(data_dir: Path | None = None) -> Settings:
    """The service's settings, with another data directory if one is given.

    Raises:
        Failure: the environment sets one of them to an invalid value.
    """
    from service import settings

    try:
        found = settings.read_settings()
    except settings.SettingsError as error:
        raise Failure(str(error)) from error
    return found if data_dir is None else found.model_copy(update={"data_dir": data_dir})
