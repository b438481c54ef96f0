"""Bags: rosbag2 (SQLite, MCAP), ROS 1, and MCAP of Foxglove; their topics, the frames of one, the path in another."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import threading
from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np

from core.errors import InvalidRecording, InvalidTrajectory, UnknownTopic
from core.frames.intrinsics import Intrinsics
from core.frames.traverses import OTHER_SUFFIXES, SUPPORTED_SUFFIXES, natural_key
from core.recordings.frame import NANOSECONDS, RecordedFrame, make_id, utc
from core.recordings.mcap_storage import McapStorage
from core.recordings.messages import (
    CAMERA_INFO,
    FIXES,
    POSE_TYPES,
    TRANSFORM_TYPES,
    VIDEO_TYPES,
    check_installed,
    frame_of,
    intrinsics_of,
    picture_of,
    pose_of,
    transforms_of,
)
from core.recordings.plausibility import MOST_SPEED, Source
from core.recordings.ros1_storage import Ros1Storage
from core.recordings.sqlite_storage import SqliteStorage
from core.recordings.storage import Entry, Storage, Topic
from core.recordings.trajectory import JudgedTrajectory
from core.recordings.transforms import TransformTree, is_absolute

STORAGES: dict[str, type[SqliteStorage] | type[McapStorage] | type[Ros1Storage]] = {
    ".db3": SqliteStorage,
    ".mcap": McapStorage,
    ".bag": Ros1Storage,
}
PACKED = ".zstd"
"""The further suffix of a file that the recorder has compressed as a whole."""

LONGEST_TOPIC = 96
"""Characters of a topic's name in the ids of places."""

MOST_NAMED = 3
"""Files that are no bag that one remark names."""

MOST_LISTED = 20
"""Topics that an error lists."""

JUMP_SECONDS, JUMP_STEPS = 60.0, 100.0
"""A clock jumps ahead if it goes on by more than a minute and a hundred times the usual step."""


OF_DIRECTORIES = (".db3", ".mcap")


def bag_files(path: Path) -> list[Path]:
    """The files of a bag by their names: the file itself, or those of a rosbag2 directory in natural order.

    There are none if the path is no bag.  A directory with pictures is none, even with other files in it.
    """
    if not path.is_dir():
        return [path] if _kind_of(path) in STORAGES else []
    try:
        entries = [one for one in path.iterdir() if not one.name.startswith(".")]
    except OSError:
        return []
    if any(one.suffix.lower() in SUPPORTED_SUFFIXES | OTHER_SUFFIXES for one in entries):
        return []
    files = [one for one in entries if _kind_of(one) in OF_DIRECTORIES]
    return sorted(files, key=lambda one: natural_key(one.name))


def _kind_of(path: Path) -> str:
    """The suffix without that of the compression."""
    return Path(path.name.removesuffix(PACKED)).suffix.lower()


def _listed(topics: dict[str, Topic]) -> str:
    """Topics with their types and counts, the first ones of many."""
    named = [f"{one} ({topic.kind}, {topic.messages} messages)" for one, topic in topics.items()]
    return "; ".join(named[:MOST_LISTED]) + (f"; and {len(named) - MOST_LISTED} more" if named[MOST_LISTED:] else "")


class Bag:
    """The files of one bag, opened.

    remarks: sentences about their content that a user must know.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag: a file, or a directory of files, of which those that are no bag are left out.

        Raises:
            MissingExtra: the reader of bags is not installed.
            InvalidRecording: a file cannot be read, or none is a bag.
        """
        check_installed()
        self.path, self.remarks = path, list[str]()
        self._lock = threading.Lock()  # of the files: frames may be loaded by any thread
        self._unpacked: tempfile.TemporaryDirectory[str] | None = None
        self._files: list[tuple[Path, Storage]] = []
        try:
            self._open_all(bag_files(path))
        except BaseException:
            self.close()
            raise

    def _open_all(self, files: Sequence[Path]) -> None:
        unfit: list[InvalidRecording] = []
        for file in files:
            try:
                self._files.append((file, self._open(file)))
            except OSError as error:
                raise InvalidRecording(f"{file} cannot be read: {error.strerror or error}.") from error
            except InvalidRecording as error:  # empty, or without its beginning
                unfit.append(error)
        if unfit and not self._files:
            raise unfit[0]
        if unfit:
            named = " ".join(map(str, unfit[:MOST_NAMED]))
            self.remarks.append(f"{len(unfit)} of {len(files)} files are left out, and the others are read: {named}")

    def _open(self, file: Path) -> Storage:
        file.open("rb").close()  # SQLite would not say why it cannot
        return STORAGES[_kind_of(file)](self._unpack(file) if file.name.endswith(PACKED) else file)

    def _unpack(self, file: Path) -> Path:
        """The file that the recorder has compressed as a whole, unpacked into a folder that goes with this object."""
        import zstandard

        self._unpacked = self._unpacked or tempfile.TemporaryDirectory(prefix="placerec-")
        unpacked = Path(self._unpacked.name) / file.name.removesuffix(PACKED)
        try:
            with file.open("rb") as packed, unpacked.open("wb") as plain:
                shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True), plain)
        except zstandard.ZstdError as error:
            self.remarks.append(f"{file.name} is cut short or damaged ({error}); the part that unpacks is read.")
        return unpacked

    def close(self) -> None:
        """Close the files."""
        for _, storage in self._files:
            storage.close()
        if self._unpacked is not None:
            self._unpacked.cleanup()

    @property
    def topics(self) -> dict[str, Topic]:
        """The topics of all files by name."""
        found: dict[str, Topic] = {}
        for _, storage in self._files:
            for name, topic in storage.topics.items():
                before = found.get(name, topic._replace(messages=0))
                found[name] = before._replace(messages=before.messages + topic.messages)
        return found

    def choose(self, name: str | None, kinds: Sequence[str], what: str) -> str:
        """The topic of this name, or without a name the only one of these types that has messages.

        Args:
            what: such topics are called in messages.

        Raises:
            UnknownTopic: there is none, it is of another type or has no message, or several could be meant.
        """
        topics = self.topics
        fitting = {one: topic for one, topic in topics.items() if topic.kind in kinds}
        there = f"It has these topics of {what}: {_listed(fitting)}."
        if not fitting:
            there = f"It has these topics: {_listed(topics)}." if topics else "It has no topics at all."
        if videos := ", ".join(f"{one} ({topic.kind})" for one, topic in topics.items() if topic.kind in VIDEO_TYPES):
            there += (
                f" Videos are not read, as {videos}: republish one as raw or compressed (ros2 run image_transport "
                "republish)."
            )
        if name is None:
            filled = [one for one, topic in fitting.items() if topic.messages]
            if len(filled) == 1:
                return self.choose(filled[0], kinds, what)
            if filled:
                there = f"Name one with --topic. {there}"
            count = f"{len(filled)} topics of {what}" if filled else f"no topic of {what}"
            raise UnknownTopic(f"{self.path} has {count}{' with messages' if fitting else ''}. {there}")
        if not fitting:
            there = f"It has no topic of {what}. {there}"
        if name not in topics:
            raise UnknownTopic(f"{self.path} has no topic {name!r}. {there}")
        topic = topics[name]
        if topic.kind not in kinds:
            raise UnknownTopic(f"The topic {name} of {self.path} is of the type {topic.kind}, not of {what}. {there}")
        if not topic.messages:
            raise UnknownTopic(f"The topic {name} of {self.path} has no messages. {there}")
        if topic.coding is None:
            raise UnknownTopic(f"The messages of {name} in {self.path} are not of ROS 1, ROS 2, protobuf or JSON.")
        return name

    def frames(self, name: str) -> list[RecordedFrame]:
        """The frames of a topic that ``choose`` has given, in the order of their times; remarks name oddities.

        The id of a frame is made of the topic and its stamp.
        """
        entries = self._once(name, self._in_time(name, self._entries(name)))
        start = make_id(name.strip("/"))[:LONGEST_TOPIC]
        frames, seen = [], Counter[int]()
        for file, entry in entries:
            taken = entry.stamp or entry.received
            seen[taken] += 1
            seconds, rest = divmod(taken, NANOSECONDS)
            written = f"{seconds}.{rest:09d}"
            again = f"~{seen[taken]}" if seen[taken] > 1 else ""
            load = partial(self._picture, file, name, entry)
            frames.append(
                RecordedFrame(f"{start}-{written}{again}", f"{name} at {written}", load, None, utc(taken), taken)
            )
        return frames

    def _once(self, name: str, entries: Sequence[tuple[int, Entry]]) -> list[tuple[int, Entry]]:
        """Entries in the order of their times, each message once; messages of one time are compared by their bytes."""
        retained, repeated, alike = list[tuple[int, Entry]](), 0, 0
        for _, group in groupby(entries, lambda one: one[1].stamp or one[1].received):
            together, seen = list(group), set[bytes]()
            for number, (file, entry) in enumerate(together):
                if len(together) > 1:
                    digest = self._digest(file, entry)
                    if digest in seen:
                        repeated += 1
                        continue
                    seen.add(digest)
                    alike += number > 0
                retained.append((file, entry))
        if repeated:
            self.remarks.append(
                f"{repeated} messages of {name} repeat another one, with its stamp and its bytes, and are left out."
            )
        if alike:
            self.remarks.append(
                f"{alike} messages of {name} have the stamp of another one, but other bytes: they are taken, and their "
                "ids end with ~2 and so on."
            )
        return retained

    def _digest(self, file: int, entry: Entry) -> bytes:
        """The digest of a message; one that cannot be read is like no other."""
        try:
            with self._lock:
                return hashlib.sha256(self._files[file][1].read(entry.key)).digest()
        except (OSError, InvalidRecording):
            return repr((file, entry.key)).encode()

    def _picture(self, file: int, name: str, entry: Entry) -> bytes:
        storage = self._files[file][1]
        with self._lock:
            data = storage.read(entry.key)
        topic = storage.topics[name]
        return picture_of(data, topic.kind, topic.coding or "cdr", topic.schema)

    def _entries(self, name: str) -> list[tuple[int, Entry]]:
        """The messages of a topic in the order of the bag, with the numbers of their files."""
        with self._lock:
            return [
                (file, entry)
                for file, (_, storage) in enumerate(self._files)
                if name in storage.topics
                for entry in storage.entries(name)
            ]

    def _in_time(self, name: str, found: list[tuple[int, Entry]]) -> list[tuple[int, Entry]]:
        """Entries in the order of their times; oddities of the times become remarks."""
        unstamped = sum(not entry.stamp for _, entry in found)
        if unstamped:
            self.remarks.append(
                f"{unstamped} of {len(found)} messages of {name} have no stamp: for them the time counts at which the "
                "bag received them."
            )
        times = np.array([entry.stamp or entry.received for _, entry in found], np.int64)
        steps = np.diff(times) / NANOSECONDS
        if (steps < 0).any():
            self.remarks.append(
                f"The times of {name} go back {(steps < 0).sum()} times in the bag, by up to {-steps.min():.3f} s: its "
                "frames are taken in the order of their times, not in that of the bag."
            )
        order = np.argsort(times, kind="stable")
        steps = np.diff(times[order]) / NANOSECONDS
        usual = float(np.median(steps)) if len(steps) else 0.0
        jumps = np.flatnonzero((steps > JUMP_SECONDS) & (steps > JUMP_STEPS * usual))
        if jumps.size:
            self.remarks.append(
                f"The times of {name} jump ahead {jumps.size} times, by up to {steps[jumps].max():.0f} s: the clock "
                "was set, or the recording was paused."
            )
        return [found[number] for number in order]

    def is_of_transforms(self, name: str) -> bool:
        """Whether a topic has transforms."""
        return name in self.topics and self.topics[name].kind in TRANSFORM_TYPES

    def camera_frame(self, name: str) -> str:
        """The frame that the first message of a topic of pictures names; empty if it names none."""
        for file, entry in self._entries(name)[:1]:
            storage = self._files[file][1]
            topic = storage.topics[name]
            with self._lock:
                data = storage.read(entry.key)
            return frame_of(data, topic.kind, topic.coding or "cdr", topic.schema).removeprefix("/")
        return ""

    def intrinsics(self, name: str) -> Intrinsics | None:
        """The intrinsics of the camera of a topic of pictures, by the ``camera_info`` beside it; None without one.

        One that cannot be used is named in the remarks.
        """
        parts = name.split("/")
        for end in (-1, -2):  # /camera/image_raw, and /camera/image_raw/compressed
            beside = "/".join([*parts[:end], "camera_info"])
            topic = self.topics.get(beside)
            if len(parts) < -end or topic is None or topic.kind != CAMERA_INFO or topic.coding not in ("cdr", "ros1"):
                continue
            for file, entry in self._entries(beside)[:1]:
                with self._lock:
                    data = self._files[file][1].read(entry.key)
                try:
                    return intrinsics_of(data, topic.coding, any(one.startswith("image_rect") for one in parts[end:]))
                except (AttributeError, IndexError, TypeError, ValueError, InvalidRecording) as error:
                    self.remarks.append(f"{beside} is not used: {error}")
        return None

    def transforms(self) -> TransformTree:
        """The transforms of all topics, such as /tf and /tf_static.

        Raises:
            InvalidRecording: a message is damaged.
        """
        tree = TransformTree()
        for name, topic in self.topics.items():
            if topic.kind not in TRANSFORM_TYPES:
                continue
            for file, entry in self._entries(name):
                with self._lock:
                    data = self._files[file][1].read(entry.key)
                tree.add(transforms_of(data, topic.kind, topic.coding or "cdr", topic.schema), entry.received)
        return tree

    def trajectory(
        self, name: str, fixed: str | None = None, moving: str | None = None, most_speed: float = MOST_SPEED
    ) -> JudgedTrajectory:
        """The path by the poses of a topic; of transforms, that of the frame ``moving`` in ``fixed``.

        Args:
            most_speed: metres a second; no vehicle is faster.

        Raises:
            UnknownTopic: the bag has no such topic of poses.
            InvalidTrajectory: no message of it has a pose, or frames are named that it does not connect.
        """
        self.choose(name, POSE_TYPES, "poses")
        if self.topics[name].kind in TRANSFORM_TYPES:
            if not moving:
                raise InvalidTrajectory("The pictures name no frame of a camera: name one with --moving-frame.")
            return self.transforms().trajectory(fixed, moving, name, most_speed)
        if fixed is not None or moving is not None:
            raise InvalidTrajectory(f"{name} has poses and no transforms: leave out --fixed-frame and --moving-frame.")
        times, poses, idle = [], [], list[int]()
        for file, entry in self._entries(name):
            storage = self._files[file][1]
            topic = storage.topics[name]
            with self._lock:
                data = storage.read(entry.key)
            pose = pose_of(data, topic.kind, topic.coding or "cdr", topic.schema)
            if pose is None:
                idle.append(entry.stamp or entry.received)
                continue
            times.append(entry.stamp or entry.received)
            poses.append(pose)
        if idle:
            self.remarks.append(
                f"{len(idle)} messages of {name} have no position (no fix; first at {min(idle) / NANOSECONDS:.3f} s) "
                "and are left out."
            )
        if not times:
            raise InvalidTrajectory(f"No message of {name} has a position.")
        publishers, publisher = np.unique([f"{pose.frame} {pose.child}" for pose in poses], return_inverse=True)
        usual = str(publishers[np.argmax(np.bincount(publisher))]).partition(" ")[0]
        of_satellites = self.topics[name].kind in FIXES
        return JudgedTrajectory.of_samples(
            times,
            np.array([pose.position for pose in poses]),
            np.array([pose.turn for pose in poses]),
            Source(name),
            of_satellites,
            of_satellites or is_absolute(usual),
            most_speed,
            publisher,
        )

    def all_remarks(self) -> list[str]:
        """All remarks, those about damaged files first."""
        damaged = [
            f"{file.name} {storage.problem}: the part that could be read is used."
            for file, storage in self._files
            if storage.problem is not None
        ]
        return damaged + self.remarks
