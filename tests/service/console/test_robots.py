"""The home page, robots of all maps, stored answers and the replay of a run."""

from __future__ import annotations

import csv
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
from playwright.sync_api import Page, Route, expect

from tests.service.console import world
from tests.service.console.conftest import Operator, Visit
from tests.service.console.world import LAB
from tests.service.map_jobs import wait_until
from tests.service.server import Server

NOW = datetime(2026, 11, 22, 18, 2, 40, tzinfo=UTC)


def robot(name: str, **fields: Any) -> dict[str, Any]:
    """A robot that was recognized just now, but for some fields; moments are seconds before now."""
    told: dict[str, Any] = {"map": LAB, "name": name, "session": None, "camera": None, "verdict": "recognized"}
    told |= {"place": "monday-03", "pose": None, "recognized_at": 1, "last_at": 1, "lost_since": None}
    told |= {"verdicts": ["recognized"], "answers": 1} | fields
    moments = ("recognized_at", "last_at", "lost_since")
    return told | {
        moment: (NOW - timedelta(seconds=told[moment])).isoformat() for moment in moments if told[moment] is not None
    }


def lost(name: str, **fields: Any) -> dict[str, Any]:
    """A robot that is lost, but for some fields; moments are seconds before now."""
    told: dict[str, Any] = {"map": LAB, "name": name, "session": None, "camera": None, "place": "monday-03"}
    told |= {"raised": True, "since": 30, "cleared_at": None, "last_at": 1} | fields
    return told | {
        moment: (NOW - timedelta(seconds=told[moment])).isoformat()
        for moment in ("since", "cleared_at", "last_at")
        if told[moment] is not None
    }


def tell(page: Page, *robots: dict[str, Any], alarms: tuple[dict[str, Any], ...] = ()) -> None:
    """Let the service say that these are the robots, and which of them are lost."""
    fleet = {"at": NOW.isoformat(), "maps": [], "robots": list(robots), "alarms": [], "lost": list(alarms)}
    page.route("**/v1/fleet", lambda route: route.fulfill(json=fleet))


@pytest.fixture
def robot_key(keys: dict[str, str], keyed: Server) -> httpx.Client:
    headers = {"Authorization": f"Bearer {keys['query']}"}
    return httpx.Client(base_url=keyed.client.base_url, headers=headers, timeout=60)


def test_home_shows_robots_answers_and_what_waits(admin: Operator, keyed: Server, robot_key: httpx.Client) -> None:
    session = robot_key.post(f"/v1/maps/{LAB}/sessions", json={}).json()["id"]
    path = f"/v1/maps/{LAB}/sessions/{session}/frames"
    robot_key.post(path, content=world.frame(2), headers={"Content-Type": "image/jpeg"}).raise_for_status()
    page = admin.go("home")
    row = page.get_by_role("region", name="Robots").get_by_role("row").filter(has_text="query-key").first
    expect(row).to_contain_text(re.compile("recognized.*lab, .*at monday-02"))
    expect(page.get_by_role("region", name="Alarms")).not_to_contain_text("query-key")
    expect(page.get_by_role("img", name=re.compile("Answers in each of the last 24 hours: \\d"))).to_be_visible()
    maps = page.get_by_role("region", name="Maps").get_by_role("row").filter(has_text=LAB)
    maps.get_by_role("link", name=LAB, exact=True).click()
    page.wait_for_url(f"**/maps/{LAB}/plan")
    page.get_by_role("link", name="placerec", exact=True).click()
    page.get_by_role("heading", name="Home").wait_for()
    robot_key.delete(f"/v1/maps/{LAB}/sessions/{session}")
    robot_key.close()


def test_a_view_that_was_left_before_its_code_came_stays_away(admin: Operator) -> None:
    held: list[Route] = []
    admin.page.route("**/views/plan.js", lambda route: held.append(route))
    page = admin.go("home")
    with page.expect_request("**/views/plan.js") as asked:
        page.evaluate(f"location.hash = '#/maps/{LAB}/plan'")
    page.evaluate("location.hash = '#/home'")
    page.get_by_role("heading", name="Home").wait_for()
    held[0].continue_()
    page.evaluate("address => import(address)", asked.value.url)
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    expect(page.get_by_role("heading", name="Home")).to_be_visible()
    assert admin.unforeseen() == []


def test_robots_that_are_lost_are_alarms_and_stay_listed_when_they_are_found(admin: Operator) -> None:
    unknown = {"verdict": "unknown", "verdicts": ["unknown"]}
    tell(
        admin.page,
        robot("robot-1", **unknown, lost_since=29),
        robot("robot-7", **unknown, lost_since=30),
        robot("robot-8", **unknown, lost_since=400, last_at=300),
        robot("robot-9", last_at=300),
        alarms=(
            lost("robot-7"),
            lost("robot-8", since=400, last_at=300),
            lost("robot-5", since=7200, raised=False, cleared_at=3600),
            lost("robot-6", since=7200, raised=False, last_at=None),
        ),
    )
    page = admin.go("home")
    found = page.get_by_role("region", name="Alarms").get_by_role("listitem")
    alarms = found.filter(has_text="robot-")  # others are of maps
    expect(alarms).to_have_text(
        [
            re.compile("alarm robot-7 lost for 30 s in lab"),
            re.compile("notice robot-8 was lost, and has been silent for 5 min"),
            re.compile(
                "cleared robot-5 was lost in lab from 2026-11-22 16:02:40 UTC until it was recognized again, "
                "2026-11-22 17:02:40 UTC"
            ),
            re.compile("cleared robot-6 was lost in lab since 2026-11-22 16:02:40 UTC, and was not recognized before"),
        ]
    )
    rows = page.get_by_role("region", name="Robots").get_by_role("row")
    for name, state in {"robot-1": "lost for 29 s", "robot-8": "silent for 5 min", "robot-9": "silent"}.items():
        expect(rows.filter(has_text=name)).to_contain_text(state)
    alarms.first.get_by_role("link").click()
    page.wait_for_url(f"**/maps/{LAB}/plan?place=monday-03")


def test_robots_are_found_by_name_and_state(visit: Visit) -> None:
    operator = visit("query")
    tell(operator.page, *(robot(f"robot-{n}", lost_since=5 if n % 2 else None) for n in range(12)))
    page = operator.go("robots")
    rows = page.get_by_role("region", name="Robots").get_by_role("row")
    expect(rows).to_have_count(13)
    page.get_by_label("State").select_option("lost")
    expect(rows).to_have_count(7)
    page.get_by_label("Name").fill("robot-1")
    expect(rows).to_have_count(3)
    page.get_by_label("Name").fill("robot-2")
    page.get_by_text("No robot fits the filters").wait_for()


def test_what_is_out_of_service_is_an_alarm(admin: Operator) -> None:
    admin.foresee("503")
    listed = {"items": [], "next_cursor": None, "quarantined": [{"id": "attic", "reason": "A page is torn."}]}
    admin.page.route("**/v1/maps?*", lambda route: route.fulfill(json=listed))
    page = admin.go("home")
    alarms = page.get_by_role("region", name="Alarms")
    expect(alarms).to_contain_text("attic is damaged and out of service")
    expect(alarms).to_contain_text("A page is torn.")


@pytest.mark.parametrize("view", ["home", "service"])
def test_a_service_that_takes_no_writes_says_so_and_is_not_called_unready(
    admin: Operator, keyed: Server, view: str
) -> None:
    told = keyed.client.get("/v1/service").json()
    told |= {"degraded": "The disk is full.", "checks": told["checks"] | {"disk": "The disk is full."}}
    admin.page.route("**/v1/service", lambda route: route.fulfill(json=told))
    page = admin.go(view)
    banner = page.get_by_role("alert")
    expect(banner).to_have_text("Writes are refused, queries are answered. The disk is full.")
    expect(page.locator("main .pill").filter(has_text=re.compile("^(ready|not ready|degraded)$"))).to_have_text(
        "degraded"
    )
    told |= {"degraded": None, "checks": told["checks"] | {"disk": "ok"}}
    page.reload()
    admin.settle(view)
    expect(page.locator("main .pill").filter(has_text=re.compile("^ready$"))).to_be_visible()
    expect(banner).to_have_count(0)


@pytest.mark.thorough
def test_the_alarms_of_maps_are_shown_while_they_are_raised_and_after(admin: Operator, keyed: Server) -> None:
    name = "alarmed"
    keyed.create_map(name)
    keyed.enrol(name, "p0", world.frame(0))
    page = admin.go("maps")
    admin.manage(name, "Edit")
    page.get_by_label("Places that have changed").fill("5")
    page.get_by_role("button", name="Save").click()
    page.get_by_text(f"The map {name} was changed.").wait_for()
    limits = {"worse_places": None, "changed_places": 5, "quiet_stretches": None}
    told = keyed.client.get(f"/v1/maps/{name}").json()
    assert told["alarms"] == limits
    with closing(sqlite3.connect(keyed.data_dir / "statistics.sqlite", timeout=60)) as file:
        # What takes days of runs is written where the service reads it, before an answer lets it check the map.
        made, now = datetime.fromisoformat(told["created_at"]).isoformat(), datetime.now(UTC)
        row = file.execute("INSERT INTO counted_maps (id, made, since) VALUES (?, ?, ?)", (name, made, now.isoformat()))
        since = (now - timedelta(hours=3)).isoformat()
        file.execute("INSERT INTO alarms VALUES (?, 'changed_places', 1, 7, ?)", (row.lastrowid, since))
        file.commit()
    admin.go("home")
    alarms = page.get_by_role("region", name="Alarms").get_by_role("listitem").filter(has_text=name)
    expect(alarms).to_contain_text(re.compile(rf"alarm 7 places have changed\. in {name} Add a look .* 3 h ago"))
    alarms.get_by_role("link").click()
    page.get_by_role("region", name="Places that have changed").get_by_text("3 h ago").wait_for()

    def is_cleared() -> bool:
        keyed.query(name, world.frame(0))
        told = keyed.client.get("/v1/fleet").json()["alarms"]
        return [one["raised"] for one in told if one["map"] == name] == [False]

    wait_until(is_cleared)
    admin.go("home")
    expect(alarms).to_contain_text("cleared Places that have changed")


@pytest.fixture(scope="module")
def run(keyed: Server, keys: dict[str, str]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """A session of five frames, and its stored answers, the first one first."""
    headers = {"Authorization": f"Bearer {keys['query']}"}
    with httpx.Client(base_url=keyed.client.base_url, headers=headers, timeout=60) as robot:
        session = robot.post(f"/v1/maps/{LAB}/sessions", json={}).json()["id"]
        for number in range(5):
            path = f"/v1/maps/{LAB}/sessions/{session}/frames"
            header = {"Content-Type": "image/jpeg"}
            robot.post(path, params={"frame": number}, content=world.frame(number), headers=header).raise_for_status()
    stored = keyed.client.get(f"/v1/maps/{LAB}/answers", params={"session": session}).json()["items"]
    yield session, stored[::-1]
    keyed.client.delete(f"/v1/maps/{LAB}/sessions/{session}")


@pytest.mark.thorough
def test_a_run_is_replayed_on_the_plan(visit: Visit, run: tuple[str, list[dict[str, Any]]]) -> None:
    session, answers = run
    operator = visit("query")
    page = operator.go(f"maps/{LAB}/answers")
    page.get_by_role("link", name=f"Replay the run {session}").first.click()
    replay = page.get_by_role("region", name="Replay")
    expect(replay).to_contain_text("5 answers stored")
    expect(replay.get_by_role("img", name=re.compile("The run on the plan of lab"))).to_be_visible()
    counts = [sum(one["verdict"] == verdict for one in answers) for verdict in ("recognized", "ambiguous", "unknown")]
    told = "{} recognized, {} ambiguous, {} unknown".format(*counts)
    expect(replay.get_by_role("img", name=f"The verdicts of the run: {told}")).to_be_visible()
    expect(replay).to_contain_text("1 of 5, frame 0")
    slider = replay.get_by_role("slider", name="Answer of the run")
    slider.focus()
    page.keyboard.press("ArrowRight")
    expect(replay).to_contain_text("2 of 5, frame 1")
    best = answers[1]["matches"][0]["place"]
    replay.get_by_role("link", name=best).wait_for()
    replay.get_by_label("Speed").select_option("20")
    replay.get_by_role("button", name="Play").click()
    expect(replay).to_contain_text("5 of 5, frame 4")
    replay.get_by_role("button", name="Play").wait_for()
    page.get_by_role("button", name="Leave the run").click()
    replay.wait_for(state="detached")


def test_answers_name_what_a_frame_said_alone_and_what_the_run_made_of_it(
    visit: Visit, keyed: Server, run: tuple[str, list[dict[str, Any]]]
) -> None:
    session, _ = run
    told = keyed.client.get(f"/v1/maps/{LAB}/answers", params={"session": session}).json()
    assert all(one["run"] is not None for one in told["items"])
    told["items"][0] |= {"verdict": "recognized", "run": "unknown"}
    told["items"] = told["items"][:1]
    operator = visit("query")
    operator.page.route("**/answers?*", lambda route: route.fulfill(json=told))
    page = operator.go(f"maps/{LAB}/answers")
    table = page.get_by_role("region", name="Answers")
    expect(table.get_by_role("columnheader")).to_contain_text(["When", "This frame alone", "The run"])
    expect(table.get_by_role("cell").nth(1)).to_contain_text("recognized")
    expect(table.get_by_role("cell").nth(2)).to_contain_text("unknown")
    page.get_by_role("button", name=re.compile("More of the answer")).click()
    facts = page.get_by_role("dialog")
    expect(facts).to_contain_text(re.compile("This frame alone.*recognized.*The run.*unknown.*as the robot was told"))


@pytest.mark.thorough
def test_answers_are_searched_and_saved_as_csv(admin: Operator, keyed: Server) -> None:
    evil = '=HYPERLINK("x")'
    told = keyed.client.get(f"/v1/maps/{LAB}/answers", params={"limit": 500}).json()
    told["items"][0] |= {"principal": evil, "place": "-1+2", "score": -0.5, "camera": 'a,"b"'}
    admin.page.route("**/answers?*", lambda route: route.fulfill(json=told))
    page = admin.go(f"maps/{LAB}/answers")
    rows = page.get_by_role("region", name="Answers").get_by_role("row")
    expect(rows).to_have_count(1 + min(100, len(told["items"])))
    page.get_by_label("Place, caller, camera").fill("hyperlink")
    expect(rows).to_have_count(2)
    page.get_by_label("Probability from").fill("1.1")
    page.get_by_text("None fits the filters.").wait_for()
    page.get_by_label("Probability from").fill("")
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save as CSV").click()
    text = saved.value.path().read_text()
    (line,) = csv.DictReader(text.splitlines())
    assert line["principal"] == "'" + evil and line["place"] == "'-1+2", "no cell is a formula"
    assert (line["score"], line["camera"]) == ("-0.5", 'a,"b"')
    page.get_by_role("button", name=re.compile("More of the answer")).click()
    page.get_by_role("dialog").get_by_text("Decision value").wait_for()
