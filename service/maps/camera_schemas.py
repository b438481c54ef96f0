"""Cameras of a map and their masks."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from core.frames.masks import Mask
from core.places import Timestamp

CAMERA_EXAMPLE: dict[str, Any] = {
    "name": "front",
    "mask": {"polygons": [[[0, 0.85], [1, 0.85], [1, 1], [0, 1]]]},
    "updated_at": "2026-11-20T10:00:00Z",
}


class CameraDefinition(BaseModel):
    """What to ignore in the frames of a camera."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"mask": CAMERA_EXAMPLE["mask"]}]})

    mask: Mask | None = Field(default=None, description="null: nothing is ignored.")


class CameraView(BaseModel):
    """One camera of a map."""

    model_config = ConfigDict(json_schema_extra={"examples": [CAMERA_EXAMPLE]})

    name: str
    mask: Mask | None
    updated_at: Timestamp


class CameraList(BaseModel):
    """All cameras of a map, by name; they are few, so there is one page."""

    items: list[CameraView]
    next_cursor: None = None
