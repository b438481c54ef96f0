"""The fleet of ``benchmarks.endurance`` has no complaints about a working service, and some about a forgetful one."""

from __future__ import annotations

import asyncio

import pytest

from benchmarks.endurance import growth, judge
from benchmarks.fleet import Fleet, Scene, Seen, Workload
from tests.service.scenes import jpeg
from tests.service.server import Server

FIXED = 4


@pytest.fixture(autouse=True)
def frequent_housekeeping(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fleet looks after the map every half second; it ends only after such a pause."""
    monkeypatch.setattr("benchmarks.fleet.HOUSEKEEPING_SECONDS", 0.5)


def plan(server: Server, map_id: str) -> Workload:
    for number in range(FIXED):
        assert server.enrol(map_id, f"fixed-{number}", jpeg(number)).status_code == 201
    scenes = [Scene(jpeg(number), jpeg(number)) for number in range(FIXED)]
    url = str(server.client.base_url)
    fixed = {f"fixed-{number}": number for number in range(FIXED)}
    return Workload(url, map_id, scenes, [jpeg(40)], fixed, robots=2, operators=0, rate=5)


@pytest.mark.thorough
def test_a_fleet_has_no_complaints_about_a_working_service(server: Server, map_id: str) -> None:
    fleet = Fleet(plan(server, map_id))
    asyncio.run(fleet.work(1.5, exports=False))
    assert not fleet.seen.complaints
    assert fleet.seen.verdicts["known places"] >= 4
    assert fleet.seen.statuses["query 200"] + fleet.unsent >= 14


@pytest.mark.thorough
@pytest.mark.parametrize("told", [False, True])
def test_a_place_that_is_lost_or_comes_back_is_reported(server: Server, map_id: str, told: bool) -> None:
    fleet = Fleet(plan(server, map_id))
    if told:
        fleet.places["fixed-0"].leaving = fleet.places["fixed-0"].gone = 0.5  # but the service has it still
    else:
        server.client.delete(f"/v1/maps/{map_id}/places/fixed-0")
    asyncio.run(fleet.work(1.0, exports=False))
    (complaint,) = fleet.seen.complaints
    assert ("came back" if told else "not the best match") in complaint


@pytest.mark.thorough
def test_operators_enrol_and_delete_and_the_counts_agree(server: Server, map_id: str) -> None:
    scenes = [Scene(jpeg(number), jpeg(number)) for number in range(40)]
    fleet = Fleet(Workload(str(server.client.base_url), map_id, scenes * 8, [], {}, 1, 1, rate=2, enrol_rate=8))
    asyncio.run(fleet.fill())
    assert fleet.alive() == server.client.get(f"/v1/maps/{map_id}").json()["places"] == 160
    asyncio.run(fleet.work(3.0, exports=False))
    assert fleet.alive() == server.client.get(f"/v1/maps/{map_id}").json()["places"]
    assert fleet.seen.statuses["enrol one 201"] and fleet.seen.statuses["delete place 204"]


def test_a_leak_and_a_slower_end_miss_their_bars() -> None:
    seen = Seen(times={"query": [(float(second), 0.01 if second < 500 else 0.05) for second in range(600)]})
    samples = [
        {"at": at, "resident_mb": 500 + at, "disk_mb": 90.0, "files": 40, "connections": 20, "threads": 9, "places": 7}
        for at in range(0, 600, 5)
    ]
    rows, figures = judge(seen, samples, 0, 600)
    bars = {str(row[0]).split(":")[0]: row[-1] for row in rows}
    assert "MISSED" in bars["resident"] and "MISSED" in bars["p99 of queries, first and last sixth"]
    assert "met" in bars["disk"] and "met" in bars["threads"] and "met" in bars["unexpected errors"]
    assert figures["growth"]["resident_mb"]["slope_per_hour"] == pytest.approx(3600)
    assert growth(samples, "disk_mb")["slope_per_hour"] == pytest.approx(0, abs=1e-6)
