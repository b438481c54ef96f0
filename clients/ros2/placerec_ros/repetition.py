"""When the transform from the map to the odometry is sent again: at a rate, ahead of its time, and never back in it."""

from __future__ import annotations

from placerec_ros.odometry import CLOCK_JUMP, NANOSECONDS


class Repetition:
    """The stamps of a transform that is repeated as odometry comes in.

    A stamp lies ahead of the odometry by ``tolerance``, so that whoever asks for the transform at the time of a laser
    scan or an image has it already. The clock of the messages rules, so that bags can be played without ``/clock``.

    Args:
        rate: stamps a second at most.
        tolerance: seconds.
    """

    def __init__(self, rate: float, tolerance: float) -> None:
        self._period, self._ahead = round(NANOSECONDS / rate), round(tolerance * NANOSECONDS)
        self._last: int | None = None

    def clear(self) -> None:
        """Begin anew."""
        self._last = None

    def due(self, stamp: int) -> int | None:
        """The stamp to send with at a moment of odometry, both in nanoseconds; None if it is too early.

        A clock that was set back by more than a second, as by a bag that is played again, begins anew.
        """
        if self._last is not None and stamp < self._last - CLOCK_JUMP * NANOSECONDS:
            self._last = None
        if self._last is not None and stamp < self._last + self._period:
            return None
        self._last = stamp
        return stamp + self._ahead
