"""The frames of an export file: places with their pictures, and the cameras that took them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from core.errors import PlacerecError
from core.frames.containers import read_header, read_structure
from core.frames.exif import read_orientation
from core.frames.images import decode, encode_png
from core.frames.intrinsics import Intrinsics
from core.maps.archives.lines import CameraLine, PlaceLine, read_line
from core.maps.archives.reading import Archive
from core.places import EARTH_RADIUS, Pose


@dataclass(frozen=True)
class PlaneOrigin:
    """The point of the Earth's sphere about which positions in degrees become metres: x east, y north."""

    latitude: float
    longitude: float

    def metres(self, pose: Pose) -> tuple[float, float]:
        """Metres east and north."""
        assert pose.latitude is not None and pose.longitude is not None
        east = (pose.longitude - self.longitude + 180) % 360 - 180
        across = np.radians(east) * EARTH_RADIUS * np.cos(np.radians(self.latitude))
        return float(across), float(np.radians(pose.latitude - self.latitude) * EARTH_RADIUS)


@dataclass(frozen=True)
class Standpoint:
    """Where a camera stood, in metres: x, y and z (0 where it is not known), and its yaw.

    yaw: radians counter-clockwise from +x to where it looks; None if that is not known.
    """

    position: NDArray[np.float64]
    yaw: float | None


@dataclass(frozen=True)
class ArchivedFrame:
    """A frame of a map, upright.

    place: its line in the export file.
    data, suffix: of the picture's file.
    width, height: pixels.
    intrinsics: for this size; None if they are not known.
    stands: None for a place without a pose.
    """

    place: PlaceLine
    data: bytes
    suffix: str
    width: int
    height: int
    intrinsics: Intrinsics | None
    stands: Standpoint | None

    @property
    def camera(self) -> str:
        """The name of its camera, or ``camera``."""
        return self.place.camera or "camera"

    @property
    def taken(self) -> datetime:
        """When it was taken or, if that is not known, enrolled."""
        return self.place.timestamp or self.place.created_at


@dataclass
class ArchivedFrames:
    """The frames of an export file, in the order in which they were enrolled.

    left_out: how many were left out so far, by the reason.
    origin: of positions in degrees: that of the first of them; None before, and in a map in metres.
    """

    archive: Archive
    left_out: Counter[str] = field(default_factory=Counter)
    origin: PlaneOrigin | None = None

    def __iter__(self) -> Iterator[ArchivedFrame]:
        """The frames of places whose pictures are stored whole; thumbnails and looks are left out.

        Raises:
            InvalidArchive: the file is damaged.
        """
        cameras = self._cameras()
        for number in range(self.archive.manifest.groups):
            places, _, pictures, _ = self.archive.manifest.group(number)
            lines, content = self.archive.part(places), self.archive.part(pictures)
            for text in lines.lines():
                line = read_line(text, PlaceLine, lines.name)
                data = b"" if line.picture is None else content.read(line.picture.bytes)
                if line.picture is None or line.picture.kind != "image":
                    self.left_out["without their images"] += 1
                elif "/" in line.id:
                    self.left_out["looks of other frames"] += 1
                else:
                    yield self._frame(line, data, cameras)
            lines.finish()
            content.finish()

    def _cameras(self) -> dict[str, Intrinsics | None]:
        part = self.archive.manifest.parts[1]
        reader = self.archive.part(part)
        found = [read_line(text, CameraLine, part.name) for text in reader.lines()]
        reader.finish()
        return {camera.name: camera.intrinsics for camera in found}

    def _frame(self, line: PlaceLine, data: bytes, cameras: dict[str, Intrinsics | None]) -> ArchivedFrame:
        header = read_header(data)
        width, height, suffix = header.width, header.height, {"jpeg": ".jpg"}.get(header.format, f".{header.format}")
        if read_orientation(read_structure(data, header).exif) != 1:  # which other tools do not apply, or twice
            pixels = decode(data)
            data, suffix = encode_png(pixels), ".png"
            height, width = pixels.shape[:2]
        known = None if line.camera is None else cameras.get(line.camera)
        return ArchivedFrame(
            line, data, suffix, width, height, _of_size(known, width, height), self._standpoint(line.pose)
        )

    def _standpoint(self, pose: Pose | None) -> Standpoint | None:
        if pose is None:
            return None
        if pose.x is not None and pose.y is not None:
            yaw = None if pose.heading is None else float(np.radians(pose.heading))
            return Standpoint(np.array([pose.x, pose.y, pose.z or 0.0]), yaw)
        assert pose.latitude is not None and pose.longitude is not None
        if self.origin is None:
            self.origin = PlaneOrigin(pose.latitude, pose.longitude)
        yaw = None if pose.heading is None else float(np.radians(90 - pose.heading))
        return Standpoint(np.array([*self.origin.metres(pose), 0.0]), yaw)


def _of_size(intrinsics: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
    """The intrinsics for frames of a size; None if they cannot be those."""
    if intrinsics is None:
        return None
    try:
        return intrinsics.of_size(width, height)
    except PlacerecError:
        return None
