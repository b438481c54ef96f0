"""The notes of a run: what its lesson needs of each frame, in memory as long as the session lasts.

A run that a crash ends teaches nothing: its notes are gone with the service.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from threading import Lock
from weakref import WeakSet

from core.learning import RunFrame, Witness
from core.store import Map
from service.access.audit import ASKER, Asker
from service.access.roles import Principal

MOST_FRAMES, MOST_BYTES = 600, 64 << 20
"""The most frames of a run, and bytes of their files, that are noted together; a longer run has several lessons."""

MOST_OF_ALL = 256 << 20
"""The most bytes of the files of all runs that a service has in memory, those that wait for their lesson included."""


@dataclass(frozen=True)
class NotedFrame:
    """One frame of a run.

    frame: as it was judged alone, without its keypoints.
    data: the bytes of its file.
    taken: when it was taken or, if the robot did not say, when it came.
    answer: to the frame alone, as review has it; JSON values.
    """

    frame: RunFrame
    data: bytes
    taken: datetime
    answer: dict[str, object]


@dataclass(eq=False)
class RunNotes:
    """The frames of one session that are noted so far.

    session: its id.
    robot: who began it.
    source: the robot, and when the session began.
    """

    session: str
    robot: Asker
    source: Witness
    frames: list[NotedFrame] = field(default_factory=list)
    bytes: int = 0

    def __post_init__(self) -> None:
        with _LOCK:
            _NOTES.add(self)

    def add(self, noted: NotedFrame) -> bool:
        """Note the next frame; whether there was room beside the notes of all other runs."""
        if noted_bytes() + len(noted.data) > MOST_OF_ALL:
            return False
        self.frames.append(noted)
        self.bytes += len(noted.data)
        return True

    def drop_odometry(self) -> None:
        """Note that odometry was wrong: the frames so far teach nothing by it."""
        self.frames = [replace(one, frame=replace(one.frame, pose=None)) for one in self.frames]

    @property
    def teaches_nothing(self) -> str | None:
        """Why the run teaches its map nothing as far as it is noted, in words; None: it may, or has no frame yet."""
        if not self.frames or any(one.frame.pose is not None for one in self.frames):
            return None
        return (
            "The run teaches its map nothing: its frames have no odometry_x, odometry_y and odometry_heading to go by."
        )

    @property
    def full(self) -> bool:
        """Whether there is no room for a further frame."""
        return len(self.frames) >= MOST_FRAMES or self.bytes >= MOST_BYTES

    def continued(self) -> RunNotes:
        """Empty notes of the same run."""
        return RunNotes(self.session, self.robot, self.source)


_LOCK = Lock()
_NOTES: WeakSet[RunNotes] = WeakSet()


def noted_bytes() -> int:
    """The bytes of the files of all runs that are noted, until nobody needs their notes any more."""
    with _LOCK:
        return sum(notes.bytes for notes in _NOTES)


def new_notes(map_: Map, session_id: str, principal: Principal) -> RunNotes | None:
    """Notes of a session that begins; None if its map learns nothing, or not from this robot.

    A robot changes a map only if its key says so (:attr:`service.access.roles.Principal.teaches`).
    """
    if map_.record.learning.mode == "off" or not principal.teaches:
        return None
    source = Witness(principal.key_id or principal.name, datetime.now(UTC))
    return RunNotes(session_id, ASKER.get(), source)
