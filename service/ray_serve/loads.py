"""Which replica has which calls of this front, as the front alone knows at every moment."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass


@dataclass
class _Call:
    frames: int
    replica: Hashable | None = None  # until it is chosen


class Loads:
    """The calls that have begun and not ended.

    Ray Serve learns how many calls a replica has from its answers, and a little later than the front that its last one
    has ended.  A front that sends the next call at this moment would miss the replica that has nothing to do.
    """

    def __init__(self) -> None:
        self._calls: dict[int, _Call] = {}

    def __len__(self) -> int:
        return len(self._calls)

    @property
    def busy(self) -> int:
        """How many replicas have calls, if each call that has no replica yet gets one of its own."""
        replicas = [call.replica for call in self._calls.values()]
        return len({replica for replica in replicas if replica is not None}) + replicas.count(None)

    def begin(self, frames: Sequence[object]) -> None:
        """Count a call; it is known by this very sequence until :meth:`end`."""
        self._calls[id(frames)] = _Call(len(frames))

    def choose(self, frames: object, replica: Hashable) -> None:
        """Note to which replica a call goes, or goes after all; calls of others are not counted."""
        if (call := self._calls.get(id(frames))) is not None:
            call.replica = replica

    def end(self, frames: Sequence[object]) -> None:
        """Forget a call that has ended."""
        del self._calls[id(frames)]

    def of(self, replica: Hashable) -> tuple[int, int]:
        """The calls that a replica has, and the frames of them."""
        frames = [call.frames for call in self._calls.values() if call.replica == replica]
        return len(frames), sum(frames)


LOADS = Loads()
"""Those of this process, in which Ray makes the router; all is counted in the event loop of the front's calls."""
