"""Bags are read in a process of their own, whose memory is limited: a bag that ends it is refused.

The libraries that parse bags were not made for hostile files: a message of a few kilobytes can become gigabytes of
objects, and an SQLite database can hold views that never end.  The child opens the bag, describes its frames, and sends
the bytes of each that is asked for; what it says is bounded, too.
"""

from __future__ import annotations

import os
import re
import resource
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import BinaryIO

from pydantic import BaseModel, ValidationError

from core import errors
from core.errors import InvalidRecording, PlacerecError
from core.frames.intrinsics import Intrinsics
from core.places import Pose
from core.recordings import Poses, RecordedFrame, Recording, open_recording
from core.recordings.frame import utc

MEMORY = 2 << 30
"""Bytes that reading may take beside what Python and its libraries have."""

MOST_FRAMES = 500_000
"""Frames of a bag; ten hours of fourteen a second."""

OPEN_SECONDS, BYTES_PER_SECOND = 300.0, 10e6
"""Opening a bag may take so long, and for each of so many bytes a second more."""

FRAME_SECONDS = 60.0
"""Each frame may take so long."""

CPU_SECONDS = 3600
"""A child whose service was killed ends when it has computed for so long, and ten times that of opening its bytes."""

LONGEST_ERROR = 1000
"""Bytes of what is wrong with a bag."""

LONGEST_TEXT = 1000
"""Characters of the name of a frame, in which its topic is, and of a remark."""

LARGEST_DESCRIPTION = 128 << 20
"""Bytes of the list of frames."""

TELLS = {
    one.__name__: one
    for one in (
        errors.InvalidRecording,
        errors.InvalidTraverse,
        errors.InvalidTrajectory,
        errors.UnknownTopic,
        errors.MissingExtra,
        errors.EmptyImage,
        errors.NotAnImage,
        errors.UnsupportedFormat,
        errors.InvalidImage,
    )
}
"""The errors that a child may report."""

OPTION = re.compile("--(topic|pose-topic|fixed-frame|moving-frame|most-speed|allow-lost-poses)")
"""An option of the command line, as errors of ``core.recordings`` name it; an order has a field of the same name."""

ENDED = "It cannot be read: it is damaged, or reading it takes too much memory or too long."
GIVEN_UP = "It was not read: frames before it have ended the reading of this bag again and again."
GIVEN, REFUSED = b"+", b"-"
HEAD = 9
"""Bytes before each answer: whether it is what was asked for, and its size."""

MOST_CHILDREN = 10
"""Children that read one bag, one after another: one more for each frame that has ended one."""


class Order(BaseModel):
    """Which bag the child reads, and how; ``most``: bytes of a frame beyond which the rest is not sent."""

    path: Path
    topic: str | None
    pose_topic: str | None
    fixed: str | None
    moving: str | None
    largest_gap: float
    most_speed: float
    prefix: str
    most: int


class DescribedFrame(BaseModel):
    """A frame but for its bytes."""

    id: str
    name: str
    pose: Pose | None
    nanoseconds: int
    segment: int
    local: Pose | None


class DescribedBag(BaseModel):
    """The frames of a bag, and what is to be said of it."""

    name: str
    remarks: list[str]
    intrinsics: Intrinsics | None = None
    frames: list[DescribedFrame]
    lost: int
    lost_by: list[str]


class Reader:
    """The child process that reads a bag, and another one after it if a frame has ended it.  Thread-safe.

    What ``check`` raises while the child opens the bag leaves the child as it is: it goes on with that, and whoever
    calls again gets what it has found.

    Args:
        order: for it.
        check: is called several times a second while it is waited for, with whether it opens the bag; it may be
            replaced.
        memory: bytes that the child may take.
    """

    def __init__(self, order: Order, check: Callable[[bool], None], memory: int = MEMORY) -> None:
        self.check = check
        self._order, self._memory, self._lock = order, memory, threading.Lock()
        self._children, self._child = 1, self._start()
        self._found, self._waited = bytearray(), 0.0  # of an answer, and seconds for which it was waited for
        self._open = False  # whether the child has described the bag
        self._described: DescribedBag | None = None

    def _start(self) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
        order = self._order.model_dump_json()
        command = [sys.executable, "-P", "-m", "service.recordings.reader", str(self._memory), order]
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
        )

    def recording(self) -> Recording:
        """The bag as the child has found it.

        Raises:
            InvalidRecording: it cannot be read, or not within the limits.
            UnknownTopic, InvalidTrajectory, MissingExtra: as of ``open_recording``.
            Others: what ``check`` raises.
        """
        with self._lock:
            told = self._described = self._describe() if self._described is None else self._described
        frames = [
            RecordedFrame(
                one.id,
                one.name,
                partial(self.load, number),
                one.pose,
                utc(one.nanoseconds),
                one.nanoseconds,
                segment=one.segment,
                local=one.local,
            )
            for number, one in enumerate(told.frames)
        ]
        recording = Recording(told.name, frames, list(told.remarks), True, told.intrinsics, told.lost, told.lost_by)
        recording.leave_out_dates(time.time())
        return recording

    def _describe(self) -> DescribedBag:
        """The description of the bag by a child that has begun."""
        seconds = OPEN_SECONDS + self._order.path.stat().st_size / BYTES_PER_SECOND
        data = self._answer(seconds, LARGEST_DESCRIPTION)
        try:
            described = DescribedBag.model_validate_json(data)
        except ValidationError as error:
            raise InvalidRecording(ENDED) from error
        self._open = True
        return described

    def load(self, number: int) -> bytes:
        """The bytes of a frame, as far as the order wants them.

        A frame that ends the child is refused, and the next one is read by a new child, up to ``MOST_CHILDREN``.

        Raises:
            InvalidRecording, InvalidImage: it cannot be read.
            Others: what ``check`` raises.
        """
        with self._lock:
            self._revive()
            assert self._child.stdin is not None
            try:
                self._child.stdin.write(b"%d\n" % number)
                self._child.stdin.flush()
            except (OSError, ValueError) as error:
                self._end()
                raise InvalidRecording(ENDED) from error
            try:
                return self._answer(FRAME_SECONDS, self._order.most)
            except PlacerecError:
                raise
            except BaseException:
                self._end()  # its answer would be taken for that of another frame
                raise

    def _revive(self) -> None:
        """Start a new child if the one before has ended, and wait until it has opened the bag.

        Raises:
            InvalidRecording: there were too many, or the bag is another one now.
            Others: what ``check`` raises; the child goes on opening the bag.
        """
        if self._child.poll() is not None:
            self._end()
            if self._children >= MOST_CHILDREN:
                raise InvalidRecording(GIVEN_UP)
            self._children, self._child, self._open = self._children + 1, self._start(), False
        if not self._open:
            again = self._describe()
            if self._described is not None and again.frames != self._described.frames:
                self._end()
                raise InvalidRecording(ENDED)

    def _answer(self, seconds: float, most: int) -> bytes:
        """The next words of the child.

        Raises:
            InvalidRecording: nothing, or more than ``most`` bytes; it is ended.
            PlacerecError: as it says.
            Others: what ``check`` raises.
        """
        try:
            head = self._read(HEAD, seconds)
            size = int.from_bytes(head[1:], "little")
            if size > (most if head[:1] == GIVEN else LONGEST_ERROR):
                raise InvalidRecording(ENDED)
            data = self._read(HEAD + size, seconds)[HEAD:]
        except InvalidRecording:
            self._end()
            raise
        self._found, self._waited = bytearray(), 0.0
        if head[:1] == GIVEN:
            return data
        kind, _, text = data.decode(errors="replace").partition(" ")
        raise TELLS.get(kind, InvalidRecording)(text)

    def _read(self, size: int, seconds: float) -> bytes:
        """The first bytes of the answer; time counts as long as they are waited for."""
        assert self._child.stdout is not None
        found, file, since = self._found, self._child.stdout.fileno(), time.monotonic() - self._waited
        while len(found) < size:
            if select.select([file], [], [], 0.1)[0]:
                part = os.read(file, min(1 << 20, size - len(found)))
                if not part:
                    raise InvalidRecording(ENDED)
                found += part
            self._waited = time.monotonic() - since
            if self._waited > seconds:
                raise InvalidRecording(ENDED)
            self.check(not self._open)  # after a look at what is there, so that each turn gets further
        return bytes(found[:size])

    def _end(self) -> None:
        """End the child, and forget the rest of its words."""
        self._child.kill()
        self._child.communicate()
        self._found, self._waited = bytearray(), 0.0

    def close(self) -> None:
        """End the child, for good."""
        self._children = MOST_CHILDREN
        self._end()


# The child


def _main() -> None:
    memory, order = int(sys.argv[1]), Order.model_validate_json(sys.argv[2])
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")  # where memory is short, this process goes first
    _limit(resource.RLIMIT_AS, _address_space() + memory)
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_CPU, CPU_SECONDS + int(order.path.stat().st_size / BYTES_PER_SECOND * 10))
    poses = Poses(order.pose_topic, None, None, order.largest_gap, order.fixed, order.moving, order.most_speed)
    try:
        recording = open_recording(order.path, order.topic, poses, order.prefix)
        if len(recording.frames) > MOST_FRAMES:
            raise InvalidRecording(f"It has {len(recording.frames)} frames; {MOST_FRAMES} are taken.")
        described = DescribedBag(
            name=recording.name,
            remarks=[_as_sent(one, order.path)[:LONGEST_TEXT] for one in recording.remarks],
            intrinsics=recording.intrinsics,
            frames=[
                DescribedFrame(
                    id=one.id,
                    name=one.name[:LONGEST_TEXT],
                    pose=one.pose,
                    nanoseconds=one.nanoseconds or 0,
                    segment=one.segment,
                    local=one.local,
                )
                for one in recording.frames
            ],
            lost=recording.lost,
            lost_by=[_as_sent(one, order.path)[:LONGEST_TEXT] for one in recording.lost_by],
        ).model_dump_json()
    except (PlacerecError, MemoryError) as error:
        _say(out, REFUSED, _told(error, order.path))
        return
    _say(out, GIVEN, described.encode())
    for line in sys.stdin:
        try:
            _say(out, GIVEN, recording.frames[int(line)].load()[: order.most])
        except (PlacerecError, OSError, MemoryError) as error:
            _say(out, REFUSED, _told(error, order.path))


def _told(error: Exception, path: Path) -> bytes:
    """An error in the words that the parent understands."""
    text = ENDED if isinstance(error, MemoryError) else _as_sent(str(error), path)
    return f"{type(error).__name__} {text}".encode(errors="replace")[:LONGEST_ERROR]


def _as_sent(text: str, path: Path) -> str:
    """Words about a bag with the name that its sender gave it, and fields of the order for options of the command.

    Where the service has put the bag concerns nobody.
    """
    return as_fields(text.replace(str(path), path.name))


def as_fields(text: str) -> str:
    """Words with fields of the order for options of the command."""
    return OPTION.sub(lambda found: found[1].replace("-", "_"), text)


def _say(out: BinaryIO, kind: bytes, data: bytes) -> None:
    out.write(kind + len(data).to_bytes(8, "little") + data)
    out.flush()


def _limit(kind: int, most: int) -> None:
    """Set a limit of this process for good, unless a lower one holds already."""
    _, hard = resource.getrlimit(kind)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(kind, (most, most))


def _address_space() -> int:
    """Bytes of memory that this process has mapped; 1 TiB, which limits nothing, where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 2**40


if __name__ == "__main__":
    _main()
