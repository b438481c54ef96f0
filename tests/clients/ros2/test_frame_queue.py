"""The queue between camera and service."""

from __future__ import annotations

import time

from placerec_ros.frame_queue import Frame, FrameQueue


def frame(number: int, arrived: float | None = None) -> Frame:
    return Frame(number, number, None, time.monotonic() if arrived is None else arrived)


def test_the_oldest_gives_way_and_is_counted() -> None:
    queue = FrameQueue(2)
    for number in range(5):
        queue.put(frame(number))
    assert queue.dropped == 3
    taken = [queue.take(0.0), queue.take(0.0), queue.take(0.0)]
    assert [one and one.number for one in taken] == [3, 4, None]
    assert queue.dropped == 3


def test_a_frame_that_waited_too_long_is_dropped() -> None:
    queue = FrameQueue(5)
    for number, arrived in enumerate((1.0, 2.0, 3.0)):
        queue.put(frame(number, arrived))
    found = queue.take(2.5)
    assert found is not None and found.number == 2
    assert queue.dropped == 2


def test_frames_that_are_cleared_were_not_dropped() -> None:
    queue = FrameQueue(5)
    queue.put(frame(1))
    queue.clear()
    assert queue.take(0.0) is None
    assert queue.dropped == 0
