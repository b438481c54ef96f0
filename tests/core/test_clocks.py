"""The time between two frames: late ones are refused, and a clock or counter that jumps locks nothing."""

from __future__ import annotations

import pytest

from core.clocks import AHEAD, CLOCK_JUMP, COUNTER_JUMP, LATE, Interval, Stamp, interval, is_ahead
from core.errors import FrameOutOfOrder

NOW = 1_795_168_800.0
"""2026-11-20T10:00:00Z."""

YEARS = 20 * 365.25 * 86_400


@pytest.mark.parametrize(
    ("last", "now", "passed", "seconds", "frames"),
    [
        (Stamp(), Stamp(NOW, 7), 0, None, 1),
        (Stamp(NOW, 7), Stamp(), 0, None, 1),
        (Stamp(NOW, 7), Stamp(NOW + 0.5, 8), 0.5, 0.5, 1),
        (Stamp(NOW, 7), Stamp(NOW, 9), 0.5, 0, 2),
        (Stamp(None, 7), Stamp(NOW, 9), 0.5, None, 2),
        (Stamp(NOW - YEARS, 7), Stamp(NOW - YEARS + 1, 8), 0.01, 1, 1),  # a recording of old, played faster
        (Stamp(NOW, 7), Stamp(NOW + 3600, 8), 1, 3600, 1),  # one with a gap
        (Stamp(NOW, 7), Stamp(NOW + YEARS, 8), YEARS, YEARS, 1),  # a robot that slept
        (Stamp(NOW + YEARS, 7), Stamp(NOW + YEARS + 1, 8), 1, 1, 1),  # whose clock is wrong all the time
        (Stamp(None, 7), Stamp(None, 7 + COUNTER_JUMP), 0, None, COUNTER_JUMP),
        (Stamp(None, 7), Stamp(None, 30_007), 1000, None, 30_000),  # many were lost
    ],
)
def test_time_goes_on(last: Stamp, now: Stamp, passed: float, seconds: float | None, frames: int) -> None:
    assert interval(last, now, passed) == Interval(seconds, frames)


@pytest.mark.parametrize(
    ("last", "now", "what"),
    [
        (Stamp(NOW), Stamp(NOW - CLOCK_JUMP - 0.01), ["clock went back"]),
        (Stamp(NOW, 7), Stamp(NOW - 3600, 8), ["clock went back"]),
        (Stamp(NOW, 7), Stamp(NOW + AHEAD + 2, 8), ["clock went ahead"]),
        (Stamp(0.0, 7), Stamp(NOW, 8), ["clock went ahead"]),  # set by the network after boot
        (Stamp(None, 7), Stamp(None, 2**31), ["numbers went from 7 to 2147483648"]),
        (Stamp(None, 2**31), Stamp(None, 8), ["numbers went from 2147483648 to 8"]),
        (Stamp(NOW, 7), Stamp(NOW + 1.5, 0), ["numbers went from 7 to 0"]),
        (Stamp(NOW, 7), Stamp(5.0, 0), ["clock went back", "numbers went from 7 to 0"]),  # a robot without a clock
        (Stamp(NOW, 7), Stamp(NOW - LATE - 1, 0), ["clock went back", "numbers went"]),  # a recording played again
    ],
)
def test_a_clock_or_a_counter_jumps(last: Stamp, now: Stamp, what: list[str]) -> None:
    found = interval(last, now, 1.0)
    assert (found.seconds, found.frames) == (None, 1)
    assert len(found.jumps) == len(what)
    for sentence, part in zip(found.jumps, what, strict=True):
        assert part in sentence


@pytest.mark.parametrize(
    ("last", "now", "named"),
    [
        (Stamp(NOW), Stamp(NOW - 0.5), ["10:00:00.000Z", "09:59:59.500Z"]),
        (Stamp(NOW), Stamp(NOW - CLOCK_JUMP), ["10:00:00.000Z", "09:59:59.000Z"]),
        (Stamp(NOW, 7), Stamp(NOW - 0.5, 8), ["10:00:00.000Z", "09:59:59.500Z"]),
        (Stamp(NOW, 7), Stamp(NOW - 20, 5), ["Frame 5", "frame 7", "10:00:00.000Z", "09:59:40.000Z"]),
        (Stamp(NOW, 7), Stamp(NOW + 0.5, 5), ["Frame 5", "frame 7", "10:00:00.500Z"]),
        (Stamp(None, 7), Stamp(None, 5), ["Frame 5", "frame 7"]),
        (Stamp(NOW, 7), Stamp(None, 5), ["Frame 5", "frame 7", "10:00:00.000Z"]),
        (Stamp(NOW, COUNTER_JUMP), Stamp(NOW - 0.5, 0), ["10:00:00.000Z", "09:59:59.500Z"]),
    ],
)
def test_a_late_frame_is_refused_with_both_times(last: Stamp, now: Stamp, named: list[str]) -> None:
    with pytest.raises(FrameOutOfOrder) as refused:
        interval(last, now, 1.0)
    assert all(part in str(refused.value) for part in [*named, "leave it out"])


@pytest.mark.parametrize(("moment", "ahead"), [(NOW + YEARS, True), (NOW + AHEAD, False), (NOW - YEARS, False)])
def test_a_time_far_ahead_is_no_date(moment: float, ahead: bool) -> None:
    assert is_ahead(moment, NOW) == ahead
