"""The audit trail: who asked is kept with a job, and a refusal that repeats fills no disk."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from service.access import audit
from service.access.audit import ASKER, Asker, Disclosures, Refusals, asker_fields, note_change
from service.jobs.jobs import Jobs
from tests.service.scenes import jpeg
from tests.service.server import Server

EVE = Asker("eve", "0123456789ab", "prune_map", "a-request", None, "10.0.0.1")


@pytest.fixture(autouse=True)
def heard(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, audit.LOGGER)


def test_what_is_not_known_is_left_out() -> None:
    assert asker_fields(EVE) == {
        "principal": "eve",
        "key": "0123456789ab",
        "operation": "prune_map",
        "request_id": "a-request",
        "client": "10.0.0.1",
    }


def test_a_request_that_changed_nothing_is_no_change(caplog: pytest.LogCaptureFixture) -> None:
    note_change(EVE, {"map": "lab"}, {"map": "lab", "verdict": "recognized", "change": None}, 200)
    assert caplog.records == []
    note_change(EVE, {"map": "lab"}, {"change": None}, 507)
    note_change(EVE, {"map": "lab"}, {"change": "created"}, 201)
    note_change(EVE, {"map": "lab", "explanation": "x"}, {}, 204)
    assert [(record.__dict__["map"], record.__dict__["status"]) for record in caplog.records] == [
        ("lab", 507),
        ("lab", 201),
        ("lab", 204),
    ]


def test_the_end_of_a_job_is_logged_with_its_caller_over_a_restart(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = Jobs.of_directory(tmp_path)
    before.register("prune", lambda _context: {})
    token = ASKER.set(EVE)
    try:
        job = before.submit("prune", "lab", arguments={"dry_run": False})
        lost = before.submit("once", "lab", lambda _context: {})
    finally:
        ASKER.reset(token)
    before.close(0.0)
    after = Jobs.of_directory(tmp_path)
    after.register("prune", lambda _context: {})
    after.start()
    while not after.get(job.id).ended:
        pass
    after.close(5.0)
    lines = {
        (record.__dict__["job"], record.getMessage()): record.__dict__
        for record in caplog.records
        if record.name == audit.LOGGER
    }
    assert set(lines) == {(lost.id, "job failed"), (job.id, "job running"), (job.id, "job succeeded")}
    for line in lines.values():
        assert asker_fields(EVE).items() <= line.items() and line["map"] == "lab"
    assert lines[lost.id, "job failed"]["problem"].endswith("job-lost")
    assert lines[job.id, "job succeeded"]["dry_run"] is False


def test_a_repeated_refusal_is_logged_once(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    refusals = Refusals()
    for _ in range(100):
        refusals.note(EVE, {"map": "lab"}, 403, "role-too-low")
    refusals.note(EVE, {"map": "lab"}, 429, "rate-exceeded")
    assert [record.__dict__["problem"] for record in caplog.records] == ["role-too-low", "rate-exceeded"]
    monkeypatch.setattr(audit, "REPEAT_SECONDS", 0.0)
    refusals.note(EVE, {"map": "lab"}, 403, "role-too-low")
    assert caplog.records[-1].__dict__["before"] == 99
    for number in range(2 * audit.MOST_KINDS):
        refusals.note(Asker("nobody", client=str(number)), {}, 401, "key-needed")
    assert len(refusals._repeats._logged) == audit.MOST_KINDS


def test_nobody_says_of_itself_where_it_calls_from(server: Server) -> None:
    """A header that a proxy would set is believed from no one who is not named as a proxy, on this machine neither."""
    forged = {"X-Forwarded-For": "6.6.6.6"}
    assert server.client.post("/v1/maps", json={"id": "by-whom"}, headers=forged).status_code == 201
    lines = server.lines_soon(logger="placerec.audit", operation="create_map", map="by-whom")
    assert [line["client"] for line in lines] == ["127.0.0.1"]


def test_who_saw_pictures_is_known(server: Server) -> None:
    """Exports, thumbnails, explanations and events with pictures: one line for what is repeated, none for a refusal."""
    server.create_map("seen", keep="image")
    assert server.enrol("seen", "p0", jpeg(0)).status_code == 201
    maps = "/v1/maps/seen"
    thumbnail = server.client.get(f"{maps}/places/p0/thumbnail")
    for path in (f"{maps}/places/p0/thumbnail", f"{maps}/export", f"{maps}/export", f"{maps}/review/labels"):
        assert server.client.get(path).status_code == 200
    unchanged = server.client.get(f"{maps}/export", headers={"If-None-Match": "*"})
    assert unchanged.status_code == 304 and thumbnail.status_code == 200
    assert server.client.get(f"{maps}/places/absent/thumbnail").status_code == 404
    for pictures in ("false", "true"):
        with server.client.stream("GET", f"{maps}/events", params={"pictures": pictures}) as events:
            assert events.status_code == 200
        lines = server.lines(logger="placerec.audit", message="shown", map="seen")
        assert ("follow_map" in [line["operation"] for line in lines]) == (pictures == "true")
    assert [(line["operation"], line["status"], line.get("place")) for line in lines] == [
        ("see_thumbnail", 200, "p0"),
        ("export_map", 200, None),
        ("export_labels", 200, None),
        ("follow_map", 200, None),
    ]
    assert {(line["principal"], line["client"]) for line in lines} == {("anonymous", "127.0.0.1")}


def test_views_are_counted_by_key_and_map(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    disclosures = Disclosures()
    for map_id in ("lab", "lab", "hall", "lab"):
        disclosures.note(EVE, {"map": map_id}, 206)
    monkeypatch.setattr(audit, "REPEAT_SECONDS", 0.0)
    disclosures.note(EVE, {"map": "lab"}, 206)
    assert [(record.__dict__["map"], record.__dict__.get("before")) for record in caplog.records] == [
        ("lab", None),
        ("hall", None),
        ("lab", 2),
    ]
