"""Recordings on the command line: the options that say which frames are taken of them, and where they were taken."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.commands.console import Failure, messages, progress, remark

if TYPE_CHECKING:
    from core.frames.masks import Mask
    from core.recordings import RecordedFrame, Recording
    from core.recordings.keyframes import Describe

PANEL = "Recordings"
MOST_APART = 1e6
"""Metres or seconds between keyframes, as in the order of a job."""

Topic = Annotated[
    str | None,
    typer.Option(help="Of a bag: the topic of the pictures; default: the only one.", rich_help_panel=PANEL),
]
PoseTopic = Annotated[
    str | None,
    typer.Option(
        help="Of a bag: the topic of poses (Odometry, PoseStamped, PoseWithCovarianceStamped, NavSatFix), or /tf.",
        rich_help_panel=PANEL,
    ),
]
FixedFrame = Annotated[
    str | None,
    typer.Option(
        metavar="FRAME", help="With --pose-topic /tf: where poses are; default: map or odom.", rich_help_panel=PANEL
    ),
]
MovingFrame = Annotated[
    str | None,
    typer.Option(
        metavar="FRAME",
        help="With --pose-topic /tf: whose poses they are; default: the camera's, by the pictures.",
        rich_help_panel=PANEL,
    ),
]
TrajectoryFile = Annotated[
    Path | None,
    typer.Option(
        "--trajectory", metavar="FILE", help="Poses from a file in the form of TUM or KITTI.", rich_help_panel=PANEL
    ),
]
TrajectoryTimes = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Seconds of each pose of a KITTI file; without it there is one pose for each frame.",
        rich_help_panel=PANEL,
    ),
]
PosesFrom = Annotated[
    Literal["names"] | None,
    typer.Option(
        "--poses",
        help="Of a folder: take poses from the file names (@east@north@…@heading@…@.jpg), as is done without being "
        "told where more than half have that form and there is no places.csv.",
        rich_help_panel=PANEL,
    ),
]
LargestGap = Annotated[
    float | None,
    typer.Option(
        min=0, help="Seconds between two poses that are bridged; default: 1.5.", rich_help_panel=PANEL, metavar="S"
    ),
]
MostSpeed = Annotated[
    float | None,
    typer.Option(
        min=1,
        help="Metres a second of the vehicle at most: poses that are reached faster are left out; default: 60.",
        rich_help_panel=PANEL,
        metavar="V",
    ),
]


def _above_zero(value: float | None) -> float | None:
    """Return a measure between keyframes, if it is one, as in the order of a job.

    Raises:
        typer.BadParameter: it is 0, or no number.
    """
    if value is not None and not 0 < value <= MOST_APART:
        raise typer.BadParameter(f"{value:g} is not more than 0 and at most {MOST_APART:g}.")
    return value


EveryMetres = Annotated[
    float | None,
    typer.Option(
        callback=_above_zero, help="Keyframes: take a frame after N metres.", rich_help_panel=PANEL, metavar="N"
    ),
]
EveryDegrees = Annotated[
    float | None,
    typer.Option(
        callback=_above_zero,
        max=180,
        help="Keyframes: or after a turn by N degrees.",
        rich_help_panel=PANEL,
        metavar="N",
    ),
]
EverySeconds = Annotated[
    float | None,
    typer.Option(callback=_above_zero, help="Keyframes: or after N seconds.", rich_help_panel=PANEL, metavar="N"),
]
EveryChange = Annotated[
    float | None,
    typer.Option(
        min=0,
        max=2,
        help="Keyframes: or when the descriptor has changed so much (1 less the cosine).",
        rich_help_panel=PANEL,
        metavar="N",
    ),
]


@dataclass(frozen=True)
class RecordingOptions:
    """The options of one recording, as they are given."""

    topic: Topic = None
    pose_topic: PoseTopic = None
    trajectory: TrajectoryFile = None
    trajectory_times: TrajectoryTimes = None
    largest_gap: LargestGap = None
    every_metres: EveryMetres = None
    every_degrees: EveryDegrees = None
    every_seconds: EverySeconds = None
    every_change: EveryChange = None
    fixed_frame: FixedFrame = None
    moving_frame: MovingFrame = None
    most_speed: MostSpeed = None
    poses: PosesFrom = None

    @contextmanager
    def open(self, path: Path, prefix: str = "") -> Iterator[Recording]:
        """Open a recording and say what is odd about it; its frames are those before any choice of keyframes.

        Raises:
            typer.BadParameter: options do not go together.
            Others: as ``core.recordings.open_recording``.
        """
        if self.pose_topic is not None and self.trajectory is not None:
            raise typer.BadParameter("give --pose-topic or --trajectory, not both")
        if self.poses is not None and (self.pose_topic is not None or self.trajectory is not None):
            raise typer.BadParameter("give --poses or another source of poses, not both")
        if self.trajectory_times is not None and self.trajectory is None:
            raise typer.BadParameter("--trajectory-times goes with --trajectory")
        # Imported here because it takes a moment.
        from core.recordings import Poses, open_recording
        from core.recordings.plausibility import MOST_SPEED
        from core.recordings.recording import LARGEST_GAP

        gap = LARGEST_GAP if self.largest_gap is None else self.largest_gap
        speed = MOST_SPEED if self.most_speed is None else self.most_speed
        files = (self.trajectory, self.trajectory_times)
        frames = (self.fixed_frame, self.moving_frame)
        poses = Poses(self.pose_topic, *files, gap, *frames, speed, self.poses == "names")
        with messages.status(f"Reading {path} …"):
            recording = open_recording(path, self.topic, poses, prefix)
            recording.leave_out_dates(time.time())
        with recording:
            for sentence in recording.remarks:
                remark(sentence)
            recording.check_format()
            yield recording

    @property
    def choosing(self) -> bool:
        """Whether not all frames are taken."""
        measures = (self.every_metres, self.every_degrees, self.every_seconds, self.every_change)
        return any(measure is not None for measure in measures)

    def choose(self, recording: Recording, encoder: str | None, mask: Mask | None = None) -> list[RecordedFrame]:
        """The frames that are taken: the keyframes that the options ask for, or all.

        Args:
            encoder: name or identity of that whose descriptors show how much a frame has changed; None for the default.
            mask: the areas to ignore in the frames.

        Raises:
            Failure: no frame can be judged by the options.
            UnknownEncoder: the encoder is not installed here.
        """
        if not self.choosing:
            return recording.frames
        from core.recordings.keyframes import Left, Spacing, keyframes

        spacing = Spacing(self.every_metres, self.every_degrees, self.every_seconds, self.every_change)
        left = Left()
        describe = None if self.every_change is None else describer(encoder, mask)
        with progress() as bar:
            task = bar.add_task("Choosing keyframes", total=len(recording.frames))
            chosen = list(keyframes(bar.track(recording.frames, task_id=task), spacing, describe, left))
        if not chosen:
            raise Failure(
                f"No frame of {recording.name} can be judged by the --every options: none has the pose, the time or "
                "the descriptor that they need."
            )
        unjudged = (
            f"; {left.unjudged} lack the pose, the time or the descriptor that is needed" if left.unjudged else ""
        )
        remark(f"{len(chosen)} of {len(recording.frames)} frames are keyframes{unjudged}.")
        return chosen


def without_stops(recording: Recording, frames: list[RecordedFrame], mask: Mask | None = None) -> list[RecordedFrame]:
    """The frames of a bag or a video without those in which nothing has changed; says how many these are.

    The frames of a folder all stay, for somebody chose them.

    Args:
        mask: the areas to ignore in the frames.
    """
    if not recording.continuous:
        return frames
    from core.belief.view import STILL, View, view_of
    from core.errors import InvalidImage, InvalidRecording
    from core.frames.images import decode
    from core.frames.masks import range_in
    from core.recordings.keyframes import moving

    with progress() as bar:
        task = bar.add_task("Looking for stops", total=len(frames))

        def look(frame: RecordedFrame) -> View | None:
            bar.advance(task)
            try:
                return view_of(decode(frame.load(), value_range=range_in(mask)), mask)
            except (InvalidImage, InvalidRecording, OSError):
                return None  # what is wrong with it is said where it is sent

        retained = list(moving(frames, look, lambda one, other: one.change(other) < STILL))
    if left_out := len(frames) - len(retained):
        remark(
            f"{left_out} of {len(frames)} frames show the same as the frame before them, as where the robot stood, and "
            "are left out; --keep-standing enrols them."
        )
    return retained


def describer(encoder: str | None, mask: Mask | None = None) -> Describe:
    """A function that describes frames by an encoder installed here; unusable frames have no descriptor."""
    import numpy as np
    from numpy.typing import NDArray

    from core.errors import InvalidImage, InvalidRecording
    from core.frames.images import decode
    from core.frames.masks import range_in
    from service.commands.encoders.models import default_encoder, open_catalogue

    used = open_catalogue(None).get(encoder or default_encoder())

    def describe(frame: RecordedFrame) -> NDArray[np.float32] | None:
        try:
            descriptor = used.encode(decode(frame.load(), value_range=range_in(mask)), mask).descriptor
        except (InvalidImage, InvalidRecording, OSError):
            return None
        length = float(np.linalg.norm(descriptor))
        return descriptor / length if length > 0 else None

    return describe
