"""``placerec settings``: the settings that the service would run with."""

from __future__ import annotations

import json
import os
from typing import Annotated

import typer

from service.commands.console import remark, show, show_json, table
from service.commands.options.settings import read_settings


def settings(as_json: Annotated[bool, typer.Option("--json", help="Write JSON instead of a table.")] = False) -> None:
    """Show every setting: its variable, its value in this environment, its default, and what it does."""
    from service.settings import PREFIX, Settings, unknown_variables

    found = read_settings()
    values = found.model_dump(mode="json")
    values["models_dir"] = str(found.models_directory)
    defaults = Settings.model_construct().model_dump(mode="json", warnings=False)
    items = [
        {
            "variable": PREFIX + name.upper(),
            "value": values[name],
            "default": defaults[name],
            "set": PREFIX + name.upper() in {variable.upper() for variable in os.environ},
            "description": field.description or "",
        }
        for name, field in Settings.model_fields.items()
    ]
    if as_json:
        show_json(items)
    else:
        shown = table("variable", "value", "default", "description")
        for item in items:
            value = _cell(item["value"])
            shown.add_row(str(item["variable"]), value, _cell(item["default"]), str(item["description"]))
        show(shown)
    for name in unknown_variables():
        remark(f"{name} is set, but there is no such setting.")


def _cell(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)
