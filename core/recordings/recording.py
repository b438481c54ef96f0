"""A recording as enrolment and evaluation take it: frames in order, with poses; from a bag, a video or a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from core.clocks import is_ahead, time_text
from core.errors import InvalidImage, InvalidRecording, InvalidTrajectory, UnsupportedFormat
from core.frames.intrinsics import Intrinsics
from core.frames.traverses import OTHER_SUFFIXES, SUPPORTED_SUFFIXES
from core.recordings.bag import Bag, bag_files
from core.recordings.folder import folder_frames
from core.recordings.frame import NANOSECONDS, RecordedFrame, make_id
from core.recordings.messages import IMAGE_TYPES
from core.recordings.plausibility import MOST_SPEED, Source, jitter_of, judge
from core.recordings.trajectory import JudgedTrajectory
from core.recordings.trajectory_files import read_trajectory
from core.recordings.video import SUFFIXES as VIDEOS
from core.recordings.video import Video

MOST_NAMED = 8
"""Parts that one remark names."""

LARGEST_GAP = 1.5
"""Seconds between two known poses between which a pose is interpolated; a satellite receiver gives one a second."""


@dataclass(frozen=True)
class Poses:
    """Where the poses of a recording come from, if not from the recording's own list or EXIF data.

    topic: of the bag.
    fixed, moving: of a topic of transforms: the frame in which poses are, and the one whose poses they are; None: map
        or odom, and the frame that the pictures name, which is that of the camera.
    file: a trajectory in the form of TUM or KITTI.
    times: of the trajectory in the form of KITTI; None if it has a pose for each frame.
    largest_gap: seconds between two poses between which one is interpolated.
    most_speed: metres a second; poses that are reached faster are left out.
    names: those in the names of the files of a folder, whatever else says poses.
    """

    topic: str | None = None
    file: Path | None = None
    times: Path | None = None
    largest_gap: float = LARGEST_GAP
    fixed: str | None = None
    moving: str | None = None
    most_speed: float = MOST_SPEED
    names: bool = False


@dataclass
class Recording:
    """The frames of a recording, in the order in which they were taken.

    name: of its file or folder, without the suffix.
    remarks: sentences about its content that a user must know.
    intrinsics: of the camera that took them, if a bag has them.
    continuous: whether its frames were taken by a clock, as those of a bag or a video, and not chosen by somebody.
    lost: how many frames lose their pose because poses are left out that cannot be.
    lost_by: sentences on what is left out, which are remarks, too.
    """

    name: str
    frames: list[RecordedFrame]
    remarks: list[str] = field(default_factory=list)
    continuous: bool = False
    intrinsics: Intrinsics | None = None
    lost: int = 0
    lost_by: list[str] = field(default_factory=list)
    _close: Callable[[], None] = lambda: None

    def leave_out_dates(self, clock: float) -> None:
        """Leave out the dates of frames that are far ahead of a clock, in seconds since 1970 UTC, and remark it."""
        dates = [one.timestamp.timestamp() for one in self.frames if one.timestamp is not None]
        if ahead := [date for date in dates if is_ahead(date, clock)]:
            self.frames = [
                replace(one, timestamp=None) if one.timestamp and is_ahead(one.timestamp.timestamp(), clock) else one
                for one in self.frames
            ]
            self.remarks.append(
                f"{len(ahead)} of {len(self.frames)} frames have dates more than a day ahead of now, up to "
                f"{time_text(max(ahead))}, which are left out: the clock of the recording was wrong."
            )

    def check_format(self) -> None:
        """Check that a frame of a bag has a format that is read; the first one has, of a bag that can be used.

        Raises:
            InvalidRecording: none has.
        """
        first: UnsupportedFormat | None = None
        for frame in self.frames if self.continuous else ():
            try:
                frame.load()
                return
            except UnsupportedFormat as error:
                first = first or error
            except (InvalidImage, InvalidRecording, OSError):  # a damaged one, which is left out alone
                return
        if first is not None:
            raise InvalidRecording(f"None of the {len(self.frames)} frames of {self.name} can be used. {first}")

    def close(self) -> None:
        """Close its files; frames cannot be loaded after that."""
        self._close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def is_recording(path: Path) -> bool:
    """Whether a path is that of a bag, a video or a directory, not of a single picture, by its name and kind."""
    return path.is_dir() or bool(bag_files(path)) or path.suffix.lower() in VIDEOS


def open_recording(path: Path, topic: str | None = None, poses: Poses = Poses(), prefix: str = "") -> Recording:
    """Open a rosbag2 (a directory, or a ``.db3`` or ``.mcap`` file), a ROS 1 bag, a video file or a folder of pictures.

    Args:
        topic: of the pictures in a bag; None for the only one that there is.
        poses: where they come from.
        prefix: of the ids of places.

    Raises:
        InvalidRecording, InvalidTraverse: it cannot be read, or has no frame; or an option does not go with it.
        UnknownTopic: the bag has no such topic, or several could be meant.
        InvalidTrajectory: the trajectory cannot be read, or does not fit the frames.
        MissingExtra: the reader of bags is not installed.
    """
    of_bag = bool(bag_files(path))
    if poses.topic is None and (poses.fixed is not None or poses.moving is not None):
        raise InvalidRecording("--fixed-frame and --moving-frame go with a --pose-topic of transforms, such as /tf.")
    for option, value in (("--topic", topic), ("--pose-topic", poses.topic)):
        if value is not None and not of_bag:
            raise InvalidRecording(f"{path} is not a bag, so it has no topics: leave out {option}.")
    if poses.times is not None and poses.file is None:
        raise InvalidTrajectory("A file of times goes with a trajectory.")
    if poses.names and (of_bag or not path.is_dir()):
        raise InvalidRecording(
            f"{path} is not a folder of pictures, so no names of files say poses: leave out --poses."
        )
    if of_bag:
        recording = _open_bag(path, topic, poses)
    else:
        recording = _open_video(path) if _is_video(path) else _open_folder(path, prefix, poses.names)
    try:
        if poses.file is not None:
            found = read_trajectory(poses.file, poses.times, poses.most_speed)
            _place(recording, found.judged, poses.largest_gap, found.poses if found.by_frame else None)
        elif not of_bag:
            _judge_poses(recording, poses.most_speed)
        if prefix and (of_bag or _is_video(path)):
            recording.frames = [replace(frame, id=_prefixed(prefix, frame.id)) for frame in recording.frames]
    except BaseException:
        recording.close()
        raise
    return recording


def _is_video(path: Path) -> bool:
    """Whether a path is to be read as a video: a file that is no picture, or a name as a video has."""
    suffix = path.suffix.lower()
    return suffix in VIDEOS or (path.is_file() and suffix not in SUPPORTED_SUFFIXES | OTHER_SUFFIXES)


def _prefixed(prefix: str, text: str) -> str:
    made = make_id(text, prefix)
    if not made.endswith(text):
        raise InvalidRecording(f"With the prefix {prefix!r} the id {text!r} would be longer than an id may be.")
    return made


def _open_bag(path: Path, topic: str | None, poses: Poses) -> Recording:
    bag = Bag(path)
    try:
        chosen = bag.choose(topic, IMAGE_TYPES, "pictures")
        recording = Recording(
            path.resolve().name if path.is_dir() else path.name.removesuffix(".zstd").rpartition(".")[0],
            bag.frames(chosen),
            continuous=True,
            intrinsics=bag.intrinsics(chosen),
            _close=bag.close,
        )
        if poses.topic is not None:
            moving = poses.moving
            if moving is None and bag.is_of_transforms(poses.topic):
                moving = bag.camera_frame(chosen)
            _place(
                recording, bag.trajectory(poses.topic, poses.fixed, moving, poses.most_speed), poses.largest_gap, None
            )
        recording.remarks = bag.all_remarks() + recording.remarks
    except BaseException:
        bag.close()
        raise
    return recording


def _open_folder(path: Path, prefix: str, by_names: bool) -> Recording:
    found = folder_frames(path, prefix, by_names)
    return Recording(path.resolve().name, found.frames, found.remarks, lost=found.lost, lost_by=list(found.lost_by))


def _open_video(path: Path) -> Recording:
    video = Video(path)
    try:
        frames, remarks = video.frames()
    except BaseException:
        video.close()
        raise
    return Recording(path.stem, frames, remarks, continuous=True, _close=video.close)


def _place(recording: Recording, judged: JudgedTrajectory, largest_gap: float, by_frame: int | None) -> None:
    """Give the frames their poses, and each part of the recording with coordinates of its own a number.

    Args:
        by_frame: how many poses there are if each frame has one of them, without times.

    Raises:
        InvalidTrajectory: the frames have no times, or another number than the poses; or no frame gets a pose, although
            none is left out.
    """
    frames = [frame.described() for frame in recording.frames]
    if by_frame is not None:
        if by_frame != len(frames):
            raise InvalidTrajectory(
                f"The trajectory has {by_frame} poses and {recording.name} has {len(frames)} frames: without a "
                "file of times there must be one for each frame."
            )
        times = [number * NANOSECONDS for number in range(len(frames))]
    else:
        times = [frame.nanoseconds for frame in frames if frame.nanoseconds is not None]
        if len(times) < len(frames):
            raise InvalidTrajectory(
                f"{len(frames) - len(times)} of {len(frames)} frames of {recording.name} have no time, so a trajectory "
                "with times gives nothing for them."
            )
    trajectory = judged.trajectory
    found = trajectory.at(times, largest_gap)
    without = np.array([pose is None for pose in found])
    segments, with_poses = (1 + np.searchsorted(judged.begins, one, "right") for one in (times, trajectory.nanoseconds))
    elsewhere = without & ~np.isin(segments, with_poses) if len(trajectory) else np.zeros(len(frames), np.bool_)
    lost = without & ~elsewhere & judged.covers(times, largest_gap)
    missing = int((without & ~elsewhere & ~lost).sum())
    if missing == len(frames):
        first, last = min(times) / NANOSECONDS, max(times) / NANOSECONDS
        raise InvalidTrajectory(
            f"No frame of {recording.name} gets a pose: its frames are of {first:.3f} s to {last:.3f} s, the poses of "
            f"{judged.span()}, and only gaps of up to {largest_gap:g} s are bridged."
        )
    recording.remarks += judged.remarks
    if elsewhere.any():
        having, lacking = (_parts(segments[some]) for some in (~elsewhere, elsewhere))
        recording.remarks.append(
            f"{elsewhere.sum()} of {len(frames)} frames are of a part whose coordinates are others: they get no pose. "
            f"Each part is a traverse of its own, and the name of a later one ends with its number. Poses are those of "
            f"{having}; there are none of {lacking}, where keyframes are chosen by coordinates that are not stored. "
            "An alignment finds which of its frames show places of another part."
        )
    recording.lost, recording.lost_by = int(lost.sum()), judged.remarks if lost.any() else []
    if lost.any():
        recording.remarks.append(f"{lost.sum()} of {len(frames)} frames lose their pose by what is left out.")
    if missing:
        recording.remarks.append(
            f"{missing} of {len(frames)} frames get no pose: they lie before the first or after the last known pose, "
            f"or in a gap of more than {largest_gap:g} s."
        )
    local = judged.local.at(times, largest_gap) if elsewhere.any() else [None] * len(frames)
    recording.frames = [
        replace(frame, pose=pose, segment=segment, local=within if other else None)
        for frame, pose, segment, within, other in zip(
            frames, found, segments.tolist(), local, elsewhere.tolist(), strict=True
        )
    ]


def _parts(segments: NDArray[np.int64]) -> str:
    """Some parts of a recording in their order, as the names of their traverses end, the first few of many."""
    numbers = np.unique(segments).tolist()
    names = ["the first one" if number == 1 else f"~{number}" for number in numbers[:MOST_NAMED]]
    more = len(numbers) - len(names)
    return ", ".join(names) + (f" and {more} more" if more else "")


def _judge_poses(recording: Recording, most_speed: float) -> None:
    """Take poses that cannot be from frames that have their own, by a list or by EXIF data."""
    frames = recording.frames
    for kind in ("metric", "geographic"):
        numbers = [at for at, frame in enumerate(frames) if frame.pose is not None and frame.pose.kind() == kind]
        poses = [pose for at in numbers if (pose := frames[at].pose) is not None]
        times = [taken for at in numbers if (taken := frames[at].nanoseconds) is not None]
        if not poses:
            continue
        positions = [
            [pose.latitude, pose.longitude, 0.0] if kind == "geographic" else [pose.x, pose.y, pose.z or 0.0]
            for pose in poses
        ]
        judgement = judge(
            times if len(times) == len(poses) else None,
            np.array(positions, np.float64),
            None,
            Source(recording.name, "frames", lambda one, of=numbers: f"{frames[of[one]].name}"),  # type: ignore[misc]
            geographic=kind == "geographic",
            absolute=True,
            most_speed=most_speed,
            jitter=jitter_of(times),
        )
        for at in np.array(numbers)[~judgement.kept].tolist():
            frames[at] = replace(frames[at], pose=None)
            recording.lost += 1
        recording.lost_by += judgement.remarks
        recording.remarks += judgement.remarks
