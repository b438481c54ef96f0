"""One frame of a recording: its id, where and when it was taken, and how its bytes are read."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

from core.errors import InvalidRecording
from core.frames.exif import read_pose_and_time
from core.names import composed
from core.places import Pose, PoseAccuracy, microseconds

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class RecordedFrame:
    """A frame that is read when it is needed.

    id: the id of its place, the same whenever the recording is opened; not a valid one if its file's name makes
        none.
    name: its name in messages, such as that of its file.
    load: reads the bytes of a JPEG, PNG or WebP file; raises OSError or InvalidImage.  Frames that are loaded in their
        order cost least, for a bag retains one unpacked chunk and a video decodes forward only.
    nanoseconds: when it was taken by the recording's own clock, which for bags counts from 1970; None if not known.
    timestamp: when it was taken, UTC; None if not known, as for a video.
    embedded: whether the timestamp, and the pose unless there is one, are those of the EXIF data of its bytes, which
        ``described`` reads.
    segment: from 1: a part of its recording, which is a traverse of its own, for its coordinates are.
    level, pose_accuracy: the storey on which it was taken, and how exact its pose is, as a list of the folder says.
    local: where it was taken in the coordinates of its segment alone, if it has no pose for that; frames of one segment
        are compared by it, and it is stored nowhere.
    """

    id: str
    name: str
    load: Callable[[], bytes]
    pose: Pose | None = None
    timestamp: datetime | None = None
    nanoseconds: int | None = None
    embedded: bool = False
    segment: int = 1
    local: Pose | None = None
    level: str | None = None
    pose_accuracy: PoseAccuracy | None = None

    def described(self, data: bytes | None = None, with_zeros: bool = False) -> RecordedFrame:
        """The frame with the pose and the time in its bytes, if that is where they are.

        Args:
            data: its bytes, if they are at hand; otherwise they are loaded.
            with_zeros: as of ``read_pose_and_time``.
        """
        if not self.embedded:
            return self
        pose, timestamp = read_pose_and_time(self.load() if data is None else data, with_zeros)
        taken = None if timestamp is None else 1000 * microseconds(timestamp)
        pose = pose if self.pose is None else self.pose
        return replace(self, pose=pose, timestamp=timestamp, nanoseconds=taken, embedded=False)


def utc(nanoseconds: int) -> datetime | None:
    """The time so long after 1970, to the microsecond; None after the year 9999."""
    try:
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=nanoseconds // 1000)
    except OverflowError:
        return None


def make_id(text: str, prefix: str = "") -> str:
    """The id of a place made from a text; characters that no id may have become hyphens.

    Raises:
        InvalidRecording: no character of an id is left.
    """
    made = re.sub(r"[^A-Za-z0-9._~-]+", "-", composed(prefix + text))
    made = re.sub(r"^[^A-Za-z0-9]+", "", made)[:128]
    if not made.strip("-"):
        raise InvalidRecording(f"No id can be made from the name {text!r}; give one in places.csv.")
    return made
