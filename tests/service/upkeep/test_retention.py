"""What is older than the settings allow goes, and nothing else."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from core.errors import NoThumbnail, StorageFailure
from core.maps import ReviewSetting
from core.places import look_address
from core.store import Map
from service.access.audit import LOGGER
from service.administration.audit_trail import AuditTrail, audit_trail
from service.app.runtime import Runtime
from service.events.feed import Feed, FeedEvent
from service.queries.given_answers import GivenAnswer, QueriedFrame
from service.queries.statistics import map_key
from service.settings import Settings
from service.upkeep.retention import Retention
from tests.service.engines import ENCODER, enrolments, runtime_at

DAY = timedelta(days=1)
NOTHING = {"review_days": 0, "picture_days": 0, "answer_days": 0, "event_days": 0, "audit_days": 0}


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    with runtime_at(tmp_path) as runtime:
        yield runtime


@pytest.fixture
def lab(runtime: Runtime) -> Map:
    made = runtime.engine.maps.create("lab", ENCODER, 8)
    made.enrol(enrolments(0, 6, "p", "monday"))
    return made


def retention(runtime: Runtime, trail: AuditTrail | None = None, **days: float) -> Retention:
    settings = Settings(data_dir=runtime.settings.data_dir, **{**NOTHING, **days})  # type: ignore[arg-type]
    return Retention(settings, runtime.retention._rooms, lambda: trail)


def given(at: datetime) -> GivenAnswer:
    values = dict.fromkeys(GivenAnswer._fields)
    return GivenAnswer(**values)._replace(at=at, frame=QueriedFrame(), matches=(("p1", 0.5),))  # type: ignore[arg-type]


def test_frames_for_review_go_after_their_days_and_labelled_ones_too(runtime: Runtime, lab: Map) -> None:
    setting = ReviewSetting()
    for number in range(4):
        lab.review.keep(f"frame {number}".encode(), {"best": "p1"}, setting)
    lab.review.label(1, {"label": {"place": "p1"}})
    now = datetime.now(UTC)
    retention(runtime).apply(now + 1000 * DAY)
    retention(runtime, review_days=90).apply(now + 89 * DAY)
    assert lab.review.page(None, 10).count == 4
    retention(runtime, review_days=90).apply(now + 91 * DAY)
    assert lab.review.page(None, 10).count == 0


def test_a_map_that_is_not_in_use_is_not_opened_for_what_it_does_not_have(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    with runtime_at(tmp_path) as runtime:
        for name in ("bare", "reviewed"):
            made = runtime.engine.maps.create(name, ENCODER, 8)
            made.enrol(enrolments(0, 2, "p", "monday"))
        made.review.keep(b"frame", {"best": "p1"}, ReviewSetting())
    with runtime_at(tmp_path) as runtime:
        retention(runtime, review_days=1, picture_days=30).apply(now + 3 * DAY)
        maps = {name: runtime.engine.maps.find(name) for name in ("bare", "reviewed")}
        assert not any(one.is_open for one in maps.values())
        assert maps["reviewed"].review.page(None, 10).count == 0
        retention(runtime, picture_days=1).apply(now + 3 * DAY)
        assert maps["bare"].is_open and maps["bare"].picture("p1") is None


def test_pictures_of_places_go_and_the_places_stay(runtime: Runtime, lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.upkeep.retention.AT_ONCE", 4)
    now = datetime.now(UTC)
    retention(runtime, picture_days=30).apply(now + 29 * DAY)
    assert lab.picture("p3") is not None
    retention(runtime, picture_days=30).apply(now + 31 * DAY)
    found, _ = lab.places(None, 10)
    assert [place.picture for place in found] == ["none"] * 6
    assert lab.picture("p3") is None and all(lab.keypoints_at(range(6)))
    assert runtime.engine.maps.verify("lab").ok and len(lab.snapshot()) == 6
    assert lab.drop_pictures(now + 31 * DAY, 4) == 0


def test_pictures_of_looks_go_like_those_of_places(runtime: Runtime, lab: Map) -> None:
    (made,) = enrolments(20, 1, "x", "monday")
    look = look_address("p1", "0" * 16)
    lab.enrol([replace(made, id=look)])
    assert lab.picture(look) == b"picture 20"
    now = datetime.now(UTC)
    retention(runtime, picture_days=30).apply(now + 31 * DAY)
    (left,) = lab.looks("p1")
    assert left.picture == "none" and lab.picture(look) is None and lab.place("p1").looks == 1
    with pytest.raises(NoThumbnail, match="keeps no picture of look '0000000000000000' of place 'p1'"):
        lab.thumbnail(look)
    assert len(lab.snapshot()) == 7 and runtime.engine.maps.verify("lab").ok


def test_answers_and_events_go(runtime: Runtime, lab: Map) -> None:
    now, key = datetime.now(UTC), map_key(lab)
    for days in (9, 6, 1):
        runtime.statistics.recent.add(key, given(now - days * DAY))
    feed = runtime.engine.events._feeds["lab"] = Feed(runtime.engine.events._lock)
    for days in (3, 2, 0):
        at = (now - days * DAY).timestamp()
        feed.add(FeedEvent(0, "query", None, frozenset({"lab"}), "{}", "{}", None, at))
    retention(runtime, answer_days=7, event_days=1).apply(now)
    assert [round((now - one.at) / DAY) for one in runtime.statistics.recent.of_map(key)] == [1, 6]
    assert [event.number for event in feed.latest] == [3] and feed.size == feed.latest[0].size


@pytest.mark.parametrize("place", ["file", "memory"])
def test_lines_of_the_audit_trail_go(runtime: Runtime, tmp_path: Path, place: str) -> None:
    path = tmp_path / "audit.log" if place == "file" else None
    now = datetime.now(UTC)
    with audit_trail(path) as trail:
        for days in (400, 380, 10, 0):
            record = logging.LogRecord(LOGGER, logging.INFO, "", 0, "change", (), None)
            record.created, record.map = (now - days * DAY).timestamp(), f"m{days}"
            logging.getLogger(LOGGER).handle(record)
        retention(runtime, trail, audit_days=1000).apply(now)
        before = None if path is None else path.stat().st_ino
        assert len(list(trail.lines(None))) == 4
        retention(runtime, trail, audit_days=365).apply(now)
        assert [(line.fields or {})["map"] for line in trail.lines(None)] == ["m0", "m10"]
        logging.getLogger(LOGGER).info("change", extra={"map": "later"})
        assert [(line.fields or {})["map"] for line in trail.lines(None)] == ["later", "m0", "m10"]
        if path is not None:
            assert path.stat().st_ino != before and path.stat().st_mode & 0o777 == 0o600
            assert [json.loads(line)["map"] for line in path.read_text().splitlines()] == ["m10", "m0", "later"]


def test_what_cannot_be_deleted_is_left_for_the_next_time(
    runtime: Runtime, lab: Map, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lab.review.keep(b"frame", {"best": "p1"}, ReviewSetting())

    def refuse(*_: object) -> int:
        raise StorageFailure("The disk refuses.")

    monkeypatch.setattr(lab, "drop_pictures", refuse)
    later = datetime.now(UTC) + 100 * DAY
    retention(runtime, picture_days=1, review_days=1).apply(later)
    assert "pictures of map lab cannot be shortened: The disk refuses." in caplog.text
    assert lab.review.page(None, 10).count == 0
