"""What diagnostics and the log say."""

from __future__ import annotations

import time

import pytest

from placerec_ros import health
from placerec_ros.health import ERROR, OK, WARN, Health


def test_a_trouble_is_logged_when_it_begins_and_when_it_is_over() -> None:
    logged: list[tuple[int, str]] = []
    state = Health(lambda level, sentence: logged.append((level, sentence)))
    for _ in range(3):
        state.begins("service", "It is gone.", ERROR)
    state.begins("camera", "It is unknown.")
    assert state.report()[:2] == (ERROR, "It is gone. It is unknown.")
    state.over("service")
    state.over("service")
    assert state.report()[:2] == (WARN, "It is unknown.")
    assert logged == [(ERROR, "It is gone."), (WARN, "It is unknown."), (OK, "This is over: It is gone.")]


def test_troubles_of_frames_are_logged_once_and_shown_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    state = Health(lambda _level, sentence: logged.append(sentence))
    for _ in range(50):
        state.frame("The encoding is wrong.")
        state.answered(0.02, None)
    state.frame("It is torn.")
    assert logged == ["The encoding is wrong.", "It is torn."]
    level, text, values = state.report()
    assert (level, text, values["frames refused"]) == (WARN, "It is torn.", "51")
    later = time.monotonic() + health.FRAME_TROUBLE_SECONDS
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert state.report()[0] == OK


def test_wordings_without_end_do_not_fill_the_log() -> None:
    logged: list[str] = []
    state = Health(lambda _level, sentence: logged.append(sentence))
    for number in range(1000):
        state.frame(f"Wording {number}.")
    assert len(logged) == health.MOST_WORDINGS


def test_the_report_has_times_and_counts() -> None:
    state = Health()
    state.state = "active"
    assert state.report()[2]["last localized"] == "never"
    for milliseconds in (10, 30, 20):
        state.answered(milliseconds / 1000, "2026-11-20 10:00:00+00:00")
    state.fact("verdict", "recognized")
    level, text, values = state.report()
    assert (level, text) == (OK, "The verdict is recognized.")
    assert values["latency, median of the last frames (ms)"] == "20.0"
    assert values["last localized"] == "2026-11-20 10:00:00+00:00"
    assert float(values["seconds since then"]) >= 0
    assert values["frames answered"] == "3"
