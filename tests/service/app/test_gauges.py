"""What Prometheus is told of how full each bounded thing is."""

from __future__ import annotations

import pytest

from tests.service.app.test_root import samples
from tests.service.conftest import STRICT
from tests.service.scenes import jpeg
from tests.service.server import Server
from tests.service.wire import get, opened, post, rest


@pytest.mark.thorough
def test_held_memory_is_reported(strict: Server) -> None:
    strict.create_map("gauged")
    assert strict.enrol("gauged", "p", jpeg(1)).status_code == 201
    assert strict.client.post("/v1/maps/gauged/sessions", json={}).status_code == 201
    with opened(strict) as slow:
        slow.sendall(post("/v1/encode", b"\xff\xd8" * 500, length=50_000))
        found = samples(strict)

    def value(name: str, **labels: str) -> float:
        return found[name, frozenset(labels.items())]

    assert value("placerec_storage_threads") == STRICT["storage_threads"]
    assert 0 <= value("placerec_storage_threads_busy") <= value("placerec_storage_threads")
    assert value("placerec_requests_under_way") >= 2, "this very one, and the slow one"
    assert value("placerec_connections", state="working") >= 2
    assert value("placerec_upload_bytes") >= 1000
    assert value("placerec_sessions") >= 1 and value("placerec_job_watchers") == 0
    assert value("placerec_event_listeners") == 0
    assert value("placerec_maps_searched", tier="exact") >= 1
    assert 0 < value("placerec_disk_free_bytes") < value("placerec_disk_bytes")
    assert value("placerec_commit_seconds_count") >= 1 and value("placerec_stopping") == 0
    assert {dict(labels)["state"] for name, labels in found if name == "placerec_jobs"} >= {"queued", "running"}
    strict.client.delete("/v1/maps/gauged")


def test_no_series_is_made_of_what_callers_make_up(strict: Server) -> None:
    def asked(number: int) -> None:
        strict.client.request(f"VERB{number}", f"/made/up/{number}")
        strict.client.get(f"/v1/maps/no-map-{number}", headers={"X-Request-Id": f"r{number}"})
        broken = opened(strict)
        broken.sendall(get(f"/{number}", "Bad header") + b"\x00")
        rest(broken)

    asked(1)
    samples(strict)  # the question for the metrics has series of its own
    before = {key for key in samples(strict) if not key[0].endswith("_created")}
    for number in range(2, 7):
        asked(number)
    assert {key for key in samples(strict) if not key[0].endswith("_created")} == before
