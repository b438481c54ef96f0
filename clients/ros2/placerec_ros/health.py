"""The health of the node, as ``/diagnostics`` shows it: troubles, counters, times.

A trouble that lasts is logged when it begins and when it is over. One of single frames is logged once in each wording.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

OK, WARN, ERROR = 0, 1, 2
"""The levels of ``diagnostic_msgs/DiagnosticStatus``."""

FRAME_TROUBLE_SECONDS = 10.0
"""How long the trouble of a single frame is shown."""
LATENCIES = 100
MOST_WORDINGS = 100


@dataclass(frozen=True)
class Trouble:
    """Something that is wrong, in a sentence; ``until`` is when it is over by itself, in monotonic seconds."""

    sentence: str
    level: int
    until: float | None = None


class Health:
    """The state of the node; every method may be called by any thread.

    Args:
        log: is called with a level and a sentence.
    """

    def __init__(self, log: Callable[[int, str], None] = lambda _level, _sentence: None) -> None:
        self._log = log
        self._lock = threading.Lock()
        self._troubles: dict[str, Trouble] = {}
        self._logged: set[str] = set()
        self._latencies: deque[float] = deque(maxlen=LATENCIES)
        self._facts: dict[str, str] = {}
        self._localized: tuple[float, str] | None = None
        self.counts: Counter[str] = Counter()
        self.state = "unconfigured"

    def begins(self, kind: str, sentence: str, level: int = WARN) -> None:
        """Note a trouble that lasts; ``kind`` replaces an earlier trouble of the same kind."""
        with self._lock:
            before = self._troubles.get(kind)
            self._troubles[kind] = Trouble(sentence, level)
        if before is None:
            self._log(level, sentence)

    def over(self, kind: str) -> None:
        """Note that a trouble is over; nothing happens if there is none of this kind."""
        with self._lock:
            gone = self._troubles.pop(kind, None)
        if gone is not None:
            self._log(OK, f"This is over: {gone.sentence}")

    def frame(self, sentence: str) -> None:
        """Note that a frame cannot be used."""
        with self._lock:
            self.counts["frames refused"] += 1
            self._troubles["frame"] = Trouble(sentence, WARN, time.monotonic() + FRAME_TROUBLE_SECONDS)
            new = sentence not in self._logged and len(self._logged) < MOST_WORDINGS
            self._logged.add(sentence) if new else None
        if new:
            self._log(WARN, sentence)

    def answered(self, seconds: float, localized: str | None) -> None:
        """Note an answer: its time, and the moment of the frame if the robot was localized."""
        with self._lock:
            self.counts["frames answered"] += 1
            self._latencies.append(seconds)
            if localized is not None:
                self._localized = time.monotonic(), localized

    def fact(self, name: str, value: object) -> None:
        """Note a value that is shown."""
        with self._lock:
            self._facts[name] = str(value)

    def reset(self) -> None:
        """Forget everything but the state."""
        with self._lock:
            self._troubles.clear()
            self._logged.clear()
            self._latencies.clear()
            self._facts.clear()
            self.counts.clear()
            self._localized = None

    def report(self) -> tuple[int, str, dict[str, str]]:
        """Level, message and values of the diagnostic status."""
        now = time.monotonic()
        with self._lock:
            for kind in [kind for kind, one in self._troubles.items() if one.until is not None and one.until <= now]:
                del self._troubles[kind]
            troubles = sorted(self._troubles.items(), key=lambda item: -item[1].level)
            values = {"state": self.state, **self._facts, **{name: str(count) for name, count in self.counts.items()}}
            if self._latencies:
                values["latency, median of the last frames (ms)"] = f"{1e3 * median(self._latencies):.1f}"
            if self._localized is None:
                values["last localized"] = "never"
            else:
                values["last localized"] = self._localized[1]
                values["seconds since then"] = f"{now - self._localized[0]:.1f}"
        for kind, one in troubles:
            values[f"trouble: {kind}"] = one.sentence
        if troubles:
            return troubles[0][1].level, " ".join(one.sentence for _, one in troubles), values
        if self.state != "active":
            return OK, f"The node is {self.state}.", values
        return OK, f"The verdict is {values.get('verdict', 'none yet')}.", values
