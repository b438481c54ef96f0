"""Bytes that are no HTTP, and a WebSocket full of nonsense."""

from __future__ import annotations

import os
import time

import pytest

from tests.fuzz import images, streams
from tests.fuzz.http import MALFORMED, NOT_IMPLEMENTED, complaint, mangled, spoken
from tests.fuzz.pictures.originals import originals
from tests.fuzz.sending import MAP
from tests.service.server import Server

SECONDS = float(os.environ.get("FUZZ_SECONDS", "0"))
"""A longer run of messages; 0: a few."""


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_no_request_is_refused_or_hung_up_on(fuzzed: Server, name: str) -> None:
    statuses, ended = spoken(fuzzed.port, MALFORMED[name])
    assert ended and len(statuses) <= 1, "bytes behind a request that is refused are none"
    assert all(400 <= status < 500 or status == NOT_IMPLEMENTED for status in statuses), statuses
    assert fuzzed.client.get("/livez").status_code == 200
    assert fuzzed.client.get("/v1/maps/smuggled").status_code == 404


def test_mangled_requests_hurt_nobody(fuzzed: Server) -> None:
    assert [wrong for sent in mangled(1, 60) if (wrong := complaint(fuzzed.port, sent))] == []
    assert fuzzed.client.get("/readyz").status_code == 200


def test_a_stream_of_nonsense_is_answered(fuzzed: Server) -> None:
    images.prepare(fuzzed.client)
    url, end, seed = str(fuzzed.client.base_url), time.monotonic() + SECONDS, 2
    assert streams.run(url, MAP, originals(), seed, count=120) == []
    while time.monotonic() < end:
        seed += 1
        assert streams.run(url, MAP, originals(), seed, count=120) == []
