"""The cameras of a map, whatever keeps them."""

from __future__ import annotations

from abc import ABC, abstractmethod

from pydantic import BaseModel, ConfigDict, Field

from core.errors import UnknownCamera
from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.places import Camera, Timestamp

MOST_CAMERAS = 256
"""Cameras of one map."""


class CameraRecord(BaseModel):
    """One camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Camera
    mask: Mask | None = Field(description="What to ignore in its frames; null: nothing.")
    intrinsics: Intrinsics | None = Field(default=None, description="Of its upright frames; null: not known.")
    updated_at: Timestamp


class KnownCameras(ABC):
    """The cameras of a map, to be asked about one."""

    @abstractmethod
    def known(self, name: str) -> CameraRecord | None:
        """One camera; None if the map has none of this name."""

    def find(self, name: str) -> CameraRecord:
        """One camera.

        Raises:
            UnknownCamera: the map has none of this name.
        """
        if (found := self.known(name)) is None:
            raise UnknownCamera(f"The map has no camera {name[:80]!r}.")
        return found

    def mask(self, name: str | None) -> Mask | None:
        """What to ignore in a frame of a camera; None without a name.

        Raises:
            UnknownCamera: the map has none of this name.
        """
        return None if name is None else self.find(name).mask

    def intrinsics(self, name: str | None) -> Intrinsics | None:
        """The intrinsics of a camera; None if they are not known, if the map has no such camera, or without a name.

        A place may name a camera that was forgotten since.
        """
        found = None if name is None else self.known(name)
        return None if found is None else found.intrinsics
