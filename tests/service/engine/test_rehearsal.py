"""A service that has rehearsed compiles nothing more, whatever it is asked for first."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from benchmarks.day.first_requests import Request, enrol, kinds
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from service.engine.rehearsal import rehearse
from tests.service.server import Server

CACHE = "[cache] "
"""How lines begin by which Numba tells that it loads a compiled loop, or has compiled one."""


@pytest.mark.thorough
@pytest.mark.timeout(600)  # of a slow machine whose cache is empty
def test_no_first_request_compiles_or_loads_a_loop_or_needs_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in the image ``slim``, which has no torch: nothing loads it that does not need it."""
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['torch'] = None\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("NUMBA_DEBUG_CACHE", "1")
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")  # what it tells is there when a request is answered
    server = Server(tmp_path, {"rehearsal": True}, forked=False)
    try:
        server.wait(seconds=500)
        assert loops(server), "Numba does not tell what it loads"
        asked_first = {"enrolment of a map": prepared(enrol, server.client), **kinds(server.client)}
        later = {}
        for name, prepare in asked_first.items():
            before = len(loops(server))
            prepare()(0)
            jobs = server.client.get("/v1/jobs").raise_for_status().json()["items"]
            assert all(job["state"] == "succeeded" for job in jobs), name
            assert "Traceback" not in server.log_file.read_text(), name
            if new := loops(server)[before:]:
                later[name] = new
        assert later == {}
        assert {job["kind"] for job in jobs} == {"align", "prune"}
        assert server.client.get("/readyz").json()["status"] == "ready"
    finally:
        server.kill()


def prepared(work: Callable[[httpx.Client], None], client: httpx.Client) -> Callable[[], Request]:
    """Something that needs no preparation, as a kind of request."""
    return lambda: lambda _: work(client)


def loops(server: Server) -> list[str]:
    """The lines of a server's output about compiled loops."""
    return [line for line in server.log_file.read_text().splitlines() if line.startswith(CACHE)]


def test_a_service_does_without_where_nothing_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "no such folder"))
    rehearse(EncoderCatalogue().get(DEFAULT_ENCODER))
    assert "nothing could be rehearsed" in caplog.text


def test_a_rehearsal_that_fails_keeps_no_service_from_being_ready(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise KeyError("a loop that cannot be compiled")

    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    monkeypatch.setattr(type(encoder), "encode", fail)
    rehearse(encoder)
    assert "nothing could be rehearsed" in caplog.text and "a loop that cannot be compiled" in caplog.text
