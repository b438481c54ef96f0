"""Whatever somebody wrote into the service is shown as they wrote it, and never becomes markup."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from tests.service.console.conftest import Operator, given_key
from tests.service.console.world import LAB, frame
from tests.service.scenes import jpeg
from tests.service.server import Server

MARKUP = "<img src=x onerror=\"window.pwned=1\"><b id='pwned'>&amp;"


def check_plain(operator: Operator, text: str = MARKUP) -> None:
    """The text stands in the page as it is, and made no element."""
    operator.page.get_by_text(text, exact=False).first.wait_for(state="attached")
    expect(operator.page.locator("#pwned")).to_have_count(0)
    assert operator.page.evaluate("window.pwned") is None


@pytest.fixture(scope="module")
def hostile(keyed: Server) -> Iterator[str]:
    """A map whose every text is markup."""
    keyed.create_map("hostile", description=MARKUP)
    for number in range(2):
        name = MARKUP.replace("/", "|") + str(number)
        answer = keyed.enrol(
            "hostile",
            f"p{number}",
            frame(number),
            sequence=name,
            x=number,
            y=0,
            metadata={MARKUP: MARKUP, "n": [MARKUP]},
        )
        assert answer.status_code == 201, answer.text
    yield "hostile"
    keyed.client.delete("/v1/maps/hostile")


@pytest.mark.thorough
def test_descriptions(admin: Operator, hostile: str) -> None:
    page = admin.go("maps")
    check_plain(admin)
    admin.manage(hostile, "Edit")
    expect(page.get_by_role("dialog").get_by_label("Description")).to_have_value(MARKUP)


def test_names_and_values_of_metadata(admin: Operator, hostile: str) -> None:
    page = admin.go(f"maps/{hostile}/places/p0")
    check_plain(admin)
    page.get_by_role("button", name="Edit").click()
    written = re.compile(re.escape(MARKUP.replace('"', '\\"')))
    expect(page.get_by_role("dialog").get_by_label("Metadata")).to_have_value(written)


@pytest.mark.thorough
@pytest.mark.parametrize("view", ["plan", "places", "traverses", "try", "calibration", "health", "enrol", "learning"])
def test_names_of_traverses(admin: Operator, hostile: str, view: str) -> None:
    admin.go(f"maps/{hostile}/{view}")
    if view in ("plan", "places", "traverses"):
        check_plain(admin, MARKUP.replace("/", "|"))
    expect(admin.page.locator("#pwned")).to_have_count(0)
    assert admin.page.evaluate("window.pwned") is None


@pytest.mark.thorough
def test_names_of_files(admin: Operator, tmp_path: Path) -> None:
    name = "<b id='pwned'>1.jpg"
    (tmp_path / name).write_bytes(jpeg(1))
    (tmp_path / "2.jpg").write_text("no picture")
    page = admin.go(f"maps/{LAB}/try")
    page.get_by_label("Pictures").set_input_files([tmp_path / "2.jpg", tmp_path / name])
    page.get_by_role("region", name="Frames", exact=True).locator(".verdict").first.wait_for()
    check_plain(admin, name)
    page.get_by_role("button", name=name).click()
    expect(page.get_by_label("The same request", exact=True)).to_contain_text("<b id=")


def test_texts_of_problems_and_of_addresses(admin: Operator) -> None:
    admin.foresee("404", "422")
    page = admin.page
    page.goto(f"{admin.root}/console#/maps/{LAB}/places/%3Cb%20id='pwned'%3Ex")
    page.get_by_role("alert").first.wait_for()
    check_plain(admin, "<b id='pwned'>x")
    page.goto(f"{admin.root}/console#/%3Cb%20id='pwned'%3E")
    page.get_by_text("There is no such view").wait_for()
    expect(page.locator("#pwned")).to_have_count(0)


def test_reasons_that_the_service_gives(admin: Operator, keyed: Server) -> None:
    problem = {
        "type": "urn:placerec:problem:x",
        "title": MARKUP,
        "detail": MARKUP,
        "request_id": MARKUP,
        "errors": [MARKUP],
    }
    admin.foresee("418")
    admin.page.route("**/v1/jobs*", lambda route: route.fulfill(status=418, json=problem))
    admin.page.goto(f"{admin.root}/console#/jobs")
    check_plain(admin)
    expect(admin.page.get_by_role("alert")).to_contain_text(re.compile("(.*" + re.escape(MARKUP) + "){4}", re.DOTALL))


@pytest.mark.thorough
def test_names_that_an_answer_may_bring(admin: Operator, keyed: Server) -> None:
    # The service refuses such names of keys, cameras and places; a page that trusted it would be one fault from ruin.
    key = {"id": MARKUP, "name": MARKUP, "role": "query", "maps": [MARKUP], "state": "in force", "own": False}
    key |= {"created_at": "2026-11-20T10:00:00Z", "expires_at": None, "revoked_at": None, "last_used_at": None}
    admin.page.route("**/v1/keys*", lambda route: route.fulfill(json={"items": [key], "next_cursor": None}))
    line = {"time": "2026-11-20T10:00:00Z", "event": MARKUP, "operation": MARKUP, "principal": MARKUP, "map": MARKUP}
    admin.page.route(
        "**/v1/audit*",
        lambda route: route.fulfill(json={"items": [{**line, "status": 200}], "next_cursor": None, "source": "file"}),
    )
    admin.go("keys")
    check_plain(admin)
    admin.go("audit")
    check_plain(admin)


@contextmanager
def opened(browser: Browser, server: Server, key: str) -> Iterator[Operator]:
    """Somebody whose page serves several tests; that pictures are missing is no complaint."""
    context = browser.new_context()
    context.set_default_timeout(15_000)
    page = context.new_page()
    page.add_init_script(given_key(key))
    yield Operator(page, f"http://127.0.0.1:{server.port}")
    context.close()


AT = "2026-11-20T10:00:00Z"
RECENT = ("camera", "session", "principal")
KEPT = ("camera", "session", "reason", "key", "request_id", "match", "label", "labelled_by")


@pytest.fixture(scope="module")
def recent(browser: Browser, keyed: Server, keys: dict[str, str]) -> Iterator[Operator]:
    """A place with a recent answer for each of its texts, in which that one is markup; cameras have such names, too."""
    answer = {
        "at": AT,
        "rank": 1,
        "frame": 7,
        "milliseconds": 1,
        "verdict": "unknown",
        "probability": 0.1,
        "score": 0.1,
    }
    items = [answer | dict.fromkeys(RECENT) | {name: MARKUP} for name in RECENT]
    told = {"items": items, "next_cursor": None, "best": 1, "recognized": 1, "last_at": None}
    cameras = {"items": [{"name": MARKUP, "mask": None}], "next_cursor": None}
    with opened(browser, keyed, keys["admin"]) as operator:
        operator.page.route("**/matches?*", lambda route: route.fulfill(json=told))
        operator.page.route("**/cameras", lambda route: route.fulfill(json=cameras))
        operator.go(f"maps/{LAB}/places/monday-03")
        yield operator


@pytest.mark.thorough
@pytest.mark.parametrize("field", RECENT)
def test_texts_of_recent_answers(recent: Operator, field: str) -> None:
    row = recent.page.get_by_role("region", name="Answers").get_by_role("row").nth(1 + RECENT.index(field))
    expect(row).to_contain_text(MARKUP[:8] if field == "session" else MARKUP)
    check_plain(recent)


@pytest.fixture(scope="module")
def kept(browser: Browser, keyed: Server, keys: dict[str, str]) -> Iterator[Operator]:
    """A review with a kept frame for each of its texts, in which that one is markup."""
    items = []
    for number, name in enumerate(KEPT):
        answer = live_event(key=None, camera=None, session=None, request_id=None, revision=1)
        answer["matches"] = [{"place": MARKUP if name == "match" else "p0", "score": 0.1}]
        frame: dict[str, Any] = {"id": number, "at": AT, "sha256": "0", "bytes": 1, "answer": answer, "label": None}
        frame |= {"labelled_at": None, "labelled_by": None}
        if name == "label":
            frame["label"] = {"place": MARKUP, "new": None, "stranger": False}
        elif name == "labelled_by":
            frame |= {"labelled_at": AT, "labelled_by": MARKUP}
        elif name != "match":
            answer[name] = MARKUP
        items.append(frame)
    told = {"items": items, "next_cursor": None, "frames": len(items), "bytes": 1}
    with opened(browser, keyed, keys["admin"]) as operator:
        operator.page.route("**/review?*", lambda route: route.fulfill(json=told))
        operator.go(f"maps/{LAB}/review")
        yield operator


@pytest.mark.thorough
@pytest.mark.parametrize("field", KEPT)
def test_texts_of_stored_frames(kept: Operator, field: str) -> None:
    kept.page.get_by_role("button", name=f"Frame {KEPT.index(field)}", exact=True).click()
    expect(kept.page.get_by_role("region", name="Frame to be labelled")).to_contain_text(MARKUP)
    check_plain(kept)


LINE, DETAILS = ("key", "camera", "session", "place", "best"), ("reason", "operation", "request_id")
"""The texts of a live answer: those of its line, which its details repeat, and those of the details alone."""


def told(page: Page, events: list[dict[str, Any]], name: str = "query") -> None:
    """Let a page's stream of events tell these, and then nothing."""
    text = "".join(f"event: {name}\ndata: {json.dumps(event)}\n\n" for event in events)
    waiting: list[Route] = []

    def answer(route: Route) -> None:
        if waiting:
            return  # as long as the test lasts
        waiting.append(route)
        route.fulfill(body=text, content_type="text/event-stream")

    page.route("**/events?*", answer)


def live_event(**fields: Any) -> dict[str, Any]:
    event: dict[str, Any] = {"at": AT, "map": LAB, "verdict": "unknown", "probability": 0.1}
    event |= {"score": 0.1, "decision": 0.1, "threshold": 0.2, "milliseconds": {"total": 1}, "pose": None, "frame": 7}
    return event | dict.fromkeys(("place", "picture", "explanation", *LINE, *DETAILS)) | fields


@pytest.fixture(scope="module")
def live(browser: Browser, keyed: Server, keys: dict[str, str]) -> Iterator[Operator]:
    """The live view with an answer for each of its texts, in which that one is markup; the last one comes first."""
    with opened(browser, keyed, keys["admin"]) as operator:
        told(operator.page, [live_event(**{name: MARKUP}) for name in (*LINE, *DETAILS)])
        operator.go(f"maps/{LAB}/live")
        yield operator


@pytest.mark.thorough
@pytest.mark.parametrize("field", [*LINE, *DETAILS])
def test_texts_of_live_answers(live: Operator, field: str) -> None:
    lines = live.page.get_by_role("list", name="Answers").get_by_role("listitem")
    line = lines.nth([*LINE, *DETAILS][::-1].index(field))
    if field in LINE:
        expect(line).to_contain_text(MARKUP)
    line.get_by_role("button", name="Why").click()
    dialog = live.page.get_by_role("dialog")
    dialog.get_by_text("Decision value").wait_for()
    expect(dialog).to_contain_text(MARKUP)
    check_plain(live)
    dialog.get_by_role("button", name="Close").click()
    expect(dialog).to_have_count(0)


@pytest.mark.thorough
def test_addresses_of_pictures_of_live_answers(admin: Operator) -> None:
    admin.foresee("401", "404")
    told(admin.page, [live_event(picture=MARKUP), live_event(explanation=f"/v1/{MARKUP}")])
    page = admin.go(f"maps/{LAB}/live")
    lines = page.get_by_role("list", name="Answers").get_by_role("listitem")
    for line in (0, 1):
        lines.nth(line).get_by_role("button", name="Why").click()
        page.get_by_role("dialog").get_by_text("Decision value").wait_for()
        expect(page.locator("#pwned")).to_have_count(0)
        page.get_by_role("dialog").get_by_role("button", name="Close").click()
    assert page.evaluate("window.pwned") is None


@pytest.mark.thorough
def test_texts_of_robots(admin: Operator) -> None:
    names = ("name", "session", "camera", "place", "map")
    known: dict[str, Any] = {"verdict": "unknown", "pose": None, "recognized_at": None, "last_at": AT, "lost_since": AT}
    known |= {"verdicts": [], "answers": 1} | dict.fromkeys(names) | {"map": LAB}
    robots = [known | {name: MARKUP} for name in names]
    lost = {"map": LAB, "name": MARKUP, "session": MARKUP, "camera": MARKUP, "place": MARKUP, "raised": True}
    lost |= {"since": AT, "cleared_at": None, "last_at": AT}
    told = {"at": "2026-11-20T10:01:00Z", "maps": [], "robots": robots, "alarms": [], "lost": [lost]}
    admin.page.route("**/v1/fleet", lambda route: route.fulfill(json=told))
    for view in ("robots", "home"):
        page = admin.go(view)
        rows = page.get_by_role("region", name="Robots").get_by_role("row")
        expect(rows).to_have_count(1 + len(names))
        check_plain(admin)


@pytest.mark.thorough
def test_names_of_maps(admin: Operator, keyed: Server) -> None:
    admin.foresee("404", "422")
    known = keyed.client.get("/v1/maps").json()
    known["items"] = [{**known["items"][0], "id": MARKUP}]
    admin.page.route("**/v1/maps?*", lambda route: route.fulfill(json=known))
    admin.go("maps")
    check_plain(admin)
    admin.page.goto(f"{admin.root}/console#/maps/{quote(MARKUP, safe='')}/live")
    check_plain(admin, f"The answers of {MARKUP}")


@pytest.mark.thorough
def test_names_of_sessions_on_the_plan(admin: Operator) -> None:
    pose = {"x": 1, "y": 2, "heading": 0, "spread": 1}
    told(admin.page, [live_event(verdict="recognized", session=MARKUP, pose=pose)])
    page = admin.go(f"maps/{LAB}/plan")
    expect(page.get_by_role("list", name="Robots")).to_contain_text(MARKUP)
    check_plain(admin)


def test_texts_turn_nothing_around(admin: Operator, keyed: Server, tmp_path: Path) -> None:
    """U+202E has what follows read from right to left: by it a text looks like another one. No name may have it."""
    keyed.create_map("turned", description="\u202ethgin yb")
    keyed.enrol("turned", "p0", frame(0), metadata={"door": "\u2066b"})
    (tmp_path / "\u202egpj.1").write_bytes(frame(1))
    (tmp_path / "2.jpg").write_bytes(frame(2))
    for view, text in (("maps", "\\u202ethgin yb"), ("maps/turned/places/p0", "\\u2066b")):
        page = admin.go(view)
        page.get_by_text(text).first.wait_for(state="attached")
        assert not re.search("[\u202e\u2066]", page.locator("body").inner_text())
    page = admin.go("maps/turned/try")
    page.get_by_label("Pictures").set_input_files([tmp_path / "2.jpg", tmp_path / "\u202egpj.1"])
    page.get_by_role("button", name="\\u202egpj.1").wait_for()
    page.get_by_role("region", name="Answer").wait_for()
    page = admin.go("maps/turned/places/p0")
    page.get_by_role("button", name="Edit").click()
    written = page.get_by_role("dialog").get_by_label("Metadata")
    expect(written).to_have_value(re.compile("\u2066b"))  # what is edited stays what it is
    admin.leave()
    keyed.client.delete("/v1/maps/turned")
