"""The root: health, counters, version, documentation."""

from __future__ import annotations

import re
import time
from pathlib import Path

import httpx
from prometheus_client.parser import text_string_to_metric_families

from core.method.catalogue import DEFAULT_ENCODER
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem


def samples(server: Server) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Every series by name and labels."""
    text = server.client.get("/metrics").text
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_liveness(client: httpx.Client) -> None:
    response = client.get("/livez")
    assert (response.status_code, response.json()) == (200, {"status": "ok"})


def test_readiness(client: httpx.Client) -> None:
    answer = client.get("/readyz").json()
    assert answer["status"] == "ready"
    assert answer["checks"] == {"encoder": "ok", "maps": "ok", "disk": "ok"}
    assert answer["encoder"] == DEFAULT_ENCODER


def test_version(client: httpx.Client) -> None:
    answer = client.get("/version").json()
    assert answer["name"] == "placerec" and re.match(r"\d+\.\d+", answer["version"])
    assert answer["version"] == client.get("/openapi.json").json()["info"]["version"]


def test_a_process_lives_before_it_is_ready_and_says_what_is_missing(tmp_path: Path) -> None:
    server = Server(tmp_path, {"encoder": "absent"}).wait("/livez")
    until = time.monotonic() + 60
    while "loading" in (response := server.client.get("/readyz")).text and time.monotonic() < until:
        time.sleep(0.1)
    problem = assert_problem(response, 503, "not-ready")
    assert "absent" in problem["checks"]["encoder"] and problem["checks"]["disk"] == "ok"
    assert 1 <= int(response.headers["retry-after"]) <= 3
    assert server.client.get("/livez").status_code == 200
    assert server.stop() == 0


def test_a_second_process_is_refused_the_data(server: Server, tmp_path: Path) -> None:
    second = Server(tmp_path, {"data_dir": server.data_dir})
    assert second.process.wait(60) != 0
    log = second.log_file.read_text()
    assert "Another process holds" in log and "Traceback" not in log
    second.client.close()


def test_metrics_count_requests_stages_and_answers(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p1", jpeg(1))
    server.query(map_id, jpeg(1))
    server.query(map_id, jpeg(2))
    found = samples(server)

    def value(name: str, **labels: str) -> float:
        return found[name, frozenset(labels.items())]

    route = "/v1/maps/{map}/query"
    assert value("placerec_request_seconds_count", route=route, method="POST", status="200") >= 2
    for stage in ("wait", "decode", "forward", "regions", "vlad"):
        assert value("placerec_encode_stage_seconds_count", stage=stage) >= 3
    assert value("placerec_search_seconds_count") >= 2
    assert value("placerec_best_score_count", map=map_id) == 2
    verdicts = [
        v for (name, labels), v in found.items() if name == "placerec_verdicts_total" and ("map", map_id) in labels
    ]
    assert sum(verdicts) == 2
    assert value("placerec_map_places", map=map_id) == 1
    assert value("placerec_queue_length") == 0
    assert value("placerec_quarantined_maps") == 0


def test_metrics_forget_a_deleted_map(server: Server) -> None:
    server.create_map("passing")
    server.enrol("passing", "p1", jpeg(1))
    server.query("passing", jpeg(1))
    server.client.delete("/v1/maps/passing")
    assert not [labels for _, labels in samples(server) if ("map", "passing") in labels]


def test_metrics_do_not_grow_with_what_callers_make_up(server: Server) -> None:
    for number in range(5):
        server.client.get(f"/made/up/{number}")
    routes = {dict(labels)["route"] for name, labels in samples(server) if name == "placerec_request_seconds_count"}
    assert "(none)" in routes and not any("made" in route for route in routes)
