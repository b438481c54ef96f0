"""Whether times can be believed: those between two frames of a run, and dates.

A frame that is a little older than the last one comes late, and is refused.  One that is much older, or leaps far
ahead, is of a clock that was set, and the run goes on by it: only the motion of that one step is not known.  So no
single value locks a run.  The ROS node has the same rule for its messages (``CLOCK_JUMP`` in ``placerec_ros``).

A time far ahead of the service's clock is no date, for nothing was taken yet to come; one of long ago may be that of
a recording.  All times are arguments; nothing here reads a clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from core.errors import FrameOutOfOrder

CLOCK_JUMP = 1.0
"""Seconds by which a frame may be older than the last one and count as late; beyond, the clock was set back."""

LATE = 60.0
"""The same of a frame whose number says, too, that it is older: it may have waited for long to be sent again."""

AHEAD = 86_400.0
"""Seconds by which a time may be ahead of the service's clock, and by which one may go on farther than that clock has:
a day, as local time differs from UTC by less."""

COUNTER_JUMP = 1000
"""By how much a number may be below the last one and count as late, and above it for each second, as no camera takes
more frames; beyond, the counter was set."""


LAST_SECOND = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC).timestamp()


@dataclass(frozen=True)
class Stamp:
    """The time and the number that a frame says of itself; None where it does not say.

    moment: by the robot's clock, seconds since 1970 UTC.
    number: the robot's number of the frame.
    """

    moment: float | None = None
    number: int | None = None


@dataclass(frozen=True)
class Interval:
    """The time between two frames that follow one another.

    seconds: None if it is not known.
    frames: by how much the number grew; 1 if that is not known.
    jumps: what has jumped, a sentence each; if anything has, nothing is known of the motion.
    """

    seconds: float | None = None
    frames: int = 1
    jumps: tuple[str, ...] = ()


def is_ahead(moment: float, clock: float) -> bool:
    """Whether a time is so far ahead of the service's clock, both seconds since 1970 UTC, that it is no date."""
    return moment - clock > AHEAD


def interval(last: Stamp, now: Stamp, passed: float) -> Interval:
    """The time from the last frame of a run to the one that comes now.

    Args:
        passed: seconds since the last frame came, by the service's clock.  Frames of a recording may come at any pace.

    Raises:
        FrameOutOfOrder: the frame is older than the last one.
    """
    seconds = None if now.moment is None or last.moment is None else now.moment - last.moment
    counted = None if now.number is None or last.number is None else now.number - last.number
    anew = False  # whether the counter was set
    if counted is not None and counted < 0:
        anew = counted < -COUNTER_JUMP or (seconds is not None and not -LATE <= seconds <= CLOCK_JUMP)
        if not anew:
            way = "" if last.moment is None else f"sends timestamps more than {CLOCK_JUMP:g} s after the last one, or "
            raise FrameOutOfOrder(
                f"Frame {now.number}{_at(now)} comes after frame {last.number}{_at(last)}: leave it out, and send "
                f"frames with numbers above {last.number}. A robot that counts anew {way}begins another session."
            )
    if seconds is not None and -CLOCK_JUMP <= seconds < 0:
        raise FrameOutOfOrder(
            f"The frame was taken{_at(now)}, before the last one{_at(last)}: leave it out, and send frames that were "
            f"taken later. A clock that goes back by more than {CLOCK_JUMP:g} s counts as set, and its frames are used."
        )
    jumps = []
    if seconds is not None and (seconds < 0 or seconds > passed + AHEAD):
        where = "back" if seconds < 0 else "ahead"
        jumps.append(f"The robot's clock went {where}: the last frame was taken{_at(last)}, this one{_at(now)}.")
    if counted is not None and (anew or counted > COUNTER_JUMP * (1 + passed)):
        jumps.append(f"The robot's numbers went from {last.number} to {now.number}.")
    return Interval(None, 1, tuple(jumps)) if jumps else Interval(seconds, counted or 1)


def future(moment: float, clock: float) -> str | None:
    """The remark on a time that :func:`is_ahead`, to follow its name; None on any other."""
    if not is_ahead(moment, clock):
        return None
    return f"{time_text(moment)} is more than a day ahead of the service's clock, {time_text(clock)}"


def time_text(moment: float) -> str:
    """A time in messages, to the millisecond; one so late that it is rounded to the year 10000 in the second before."""
    text = datetime.fromtimestamp(min(moment, LAST_SECOND), UTC).isoformat(timespec="milliseconds")
    return text.replace("+00:00", "Z")


def _at(stamp: Stamp) -> str:
    return "" if stamp.moment is None else f" at {time_text(stamp.moment)}"
