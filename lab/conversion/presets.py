"""The published networks in ``presets.toml``: input, output, aggregation and citation."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from core.networks.description import NetworkDescription

IMAGENET: dict[str, Any] = {
    "channel_order": "rgb",
    "mean": tuple(255 * value for value in (0.485, 0.456, 0.406)),
    "scale": tuple(1 / (255 * value) for value in (0.229, 0.224, 0.225)),
    "resize": "area",
}
"""Mean and deviation of ImageNet's pictures, by which all of these networks normalize theirs."""


def _description(table: dict[str, Any]) -> NetworkDescription:
    return NetworkDescription.model_validate(
        {"output": {"kind": "descriptor"}, **table, "input": {**IMAGENET, **table["input"]}}
    )


PRESETS = {
    name: _description(table)
    for name, table in tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8")).items()
}
"""The description of each network by the name of its preset."""
