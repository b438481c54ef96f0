"""The cameras of a map, whatever keeps them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict, Field

from core.errors import UnknownCamera
from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask, with_range
from core.frames.value_ranges import ValueRange
from core.places import Camera, Timestamp

MOST_CAMERAS = 256
"""Cameras of one map."""


class CameraRecord(BaseModel):
    """One camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Camera
    mask: Mask | None = Field(description="The areas to ignore in its frames; null: none.")
    intrinsics: Intrinsics | None = Field(default=None, description="Of its upright frames; null: not known.")
    value_range: ValueRange | None = Field(default=None, description="Of frames of 16 bits; null: all.")
    updated_at: Timestamp

    def settings(self) -> tuple[Mask | None, Intrinsics | None, ValueRange | None]:
        """What ``Cameras.put`` takes besides the name."""
        return self.mask, self.intrinsics, self.value_range


class KnownCameras(ABC):
    """The cameras of a map by name."""

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
        """The mask of a camera, the parts of its frames to ignore, with the range of its values; None without a name.

        Raises:
            UnknownCamera: the map has none of this name.
        """
        if name is None:
            return None
        found = self.find(name)
        return with_range(found.mask, found.value_range)

    def intrinsics(self, name: str | None) -> Intrinsics | None:
        """The intrinsics of a camera; None if they are not known, if the map has no such camera, or without a name.

        A place may name a camera that was forgotten since.
        """
        found = None if name is None else self.known(name)
        return None if found is None else found.intrinsics


class ReadCameras(KnownCameras):
    """Cameras that are in memory, so that looking one up does not wait.

    Args:
        cameras: all of one map.
    """

    def __init__(self, cameras: Iterable[CameraRecord]) -> None:
        self._cameras = {camera.name: camera for camera in cameras}

    def known(self, name: str) -> CameraRecord | None:
        """One camera; None if the map had none of this name."""
        return self._cameras.get(name)
