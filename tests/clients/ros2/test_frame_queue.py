"""The queue between camera and service."""

from __future__ import annotations

import time

from placerec_ros.frame_queue import Frame, FrameQueue, Moments


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


def together(moments: Moments, *taken: tuple[str, int]) -> list[list[list[str]]]:
    """For each frame that is taken in, the moments that are over by it, as the cameras of their frames."""
    found = []
    for number, (camera, stamp) in enumerate(taken):
        over = moments.add(Frame(number, stamp, None, camera=camera))
        found.append([[f"{one.camera} {one.stamp}" for one in group.moment] for group in over])
    return found


def test_frames_of_one_moment_are_put_together() -> None:
    moments = Moments(["front", "left"], 5)
    assert together(moments, ("front", 100), ("left", 103), ("left", 200), ("front", 196)) == [
        *([], [["front 100", "left 103"]]),
        *([], [["left 200", "front 196"]]),
    ]


def test_a_moment_ends_without_a_camera_that_sees_nothing() -> None:
    moments = Moments(["front", "left", "rear"], 5)
    assert together(moments, ("front", 100), ("left", 101), ("front", 200), ("left", 206)) == [
        *([], []),
        [["front 100", "left 101"]],
        [["front 200"]],
    ]
    assert together(Moments(["front", "left"], 5), ("front", 100), ("front", 102)) == [[], [["front 100"]]]
    moments.clear()
    assert together(moments, ("rear", 300)) == [[]], "what waited is forgotten"
    assert together(Moments(["front"], 0), ("front", 1), ("front", 2)) == [[["front 1"]], [["front 2"]]]
