"""Asking in the console: pictures, the webcam, live answers and robots on the plan."""

from __future__ import annotations

import base64
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import cv2
import pytest
from playwright.sync_api import expect

from tests.service.console.conftest import Operator, Visit
from tests.service.console.world import LAB, foreign_frame, frame_again
from tests.service.scenes import encoded, scene, seen_again
from tests.service.server import Server
from tests.service.wire import eventually


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """A folder of frames: one of a known place, one of an unknown one, one of a kind that the service does not take."""
    (tmp_path / "known.jpg").write_bytes(encoded(seen_again(scene(3), seed=70)))
    (tmp_path / "foreign.jpg").write_bytes(foreign_frame())
    cv2.imwrite(str(tmp_path / "known.bmp"), seen_again(scene(5), seed=71))
    (tmp_path / "text.jpg").write_text("no picture")
    return tmp_path


@pytest.mark.thorough
def test_a_picture_is_queried_and_the_answer_explained(visit: Visit, pictures: Path) -> None:
    page = visit("query").go(f"maps/{LAB}/try")
    page.get_by_label("Pictures").set_input_files(pictures / "known.jpg")
    answer = page.get_by_role("region", name="Answer")
    answer.get_by_text("recognized").wait_for()
    expect(answer).to_contain_text(re.compile(r"(mon|tues)day-03"))
    expect(answer).to_contain_text("probable")
    answer.locator("svg line").nth(8).wait_for(state="attached")  # inliers are drawn over both frames
    answer.get_by_role("button", name="Cells").click()
    answer.locator("svg.cells line").first.wait_for(state="attached")
    answer.get_by_role("button", name="Nothing").click()
    expect(answer.locator("svg")).to_have_count(0)
    matches = page.get_by_role("region", name="Matches").get_by_role("listitem")
    expect(matches).to_have_count(5)
    matches.nth(4).get_by_role("button").click()
    answer.get_by_text("rank 5").wait_for()
    page.get_by_role("img", name=re.compile("Shares of the words")).wait_for()
    expect(page.locator(".stages")).to_contain_text("total")


SENTENCE = """async (answer) => {
  const folder = document.querySelector("link[href$='shared/api.js']").href.replace("api.js", "answer.js");
  return (await import(folder)).sentenceOf(answer);
}"""


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        (
            {"margin": 0.023, "inliers": 139},
            "0.084 is above 0.061; the next place is 0.023 behind; geometry agrees on 139 points.",
        ),
        ({"margin": 0.023}, "0.084 is above 0.061; the next place is 0.023 behind."),
        ({"decision": 0.0611}, "0.0611 is above 0.0610; no other place comes into question."),
        ({"decision": 0.061}, "0.061000 is at 0.061000; no other place comes into question."),
        (
            {"decision": 0.02, "margin": -0.01, "verdict": "unknown"},
            "0.020 is below 0.061; another place is 0.010 ahead.",
        ),
        (
            {"decision": 0.02, "margin": 0.01, "inliers": 88},
            "0.020 is below 0.061; the next place is 0.010 behind; geometry agrees on 88 points, "
            "which makes it 97\u00a0% probable.",
        ),
    ],
)
def test_an_answer_is_one_sentence(admin: Operator, fields: dict[str, Any], told: str) -> None:
    answer = {"verdict": "recognized", "decision": 0.084, "threshold": 0.061, "margin": None, "probability": 0.97}
    answer |= {"matches": [{"parts": {"inliers": fields.get("inliers")}}]}
    page = admin.go("jobs")
    assert (
        page.evaluate(SENTENCE, answer | {k: v for k, v in fields.items() if k != "inliers"}).replace("−", "-") == told
    )


@pytest.mark.thorough
def test_an_answer_begins_with_why_and_where_and_of_the_unknown_shows_the_strongest_lines(
    visit: Visit, keyed: Server, pictures: Path
) -> None:
    page = visit("query").go(f"maps/{LAB}/try")
    page.get_by_label("Verify").select_option("never")
    page.get_by_label("Pictures").set_input_files(pictures / "known.jpg")
    answer = page.get_by_role("region", name="Answer")
    expect(answer).to_contain_text(re.compile(r"0\.\d+ is above 0\.\d+; the next place is 0\.\d+ behind\."))
    page.get_by_role("img", name=re.compile("The place, (mon|tues)day-03, on the plan of lab")).wait_for()
    page.get_by_label("Among").select_option("monday")
    told = keyed.client.post(
        f"/v1/maps/{LAB}/query",
        params={"verify": "never", "sequences": "monday"},
        content=foreign_frame(),
        headers={"Content-Type": "image/jpeg"},
    ).json()
    assert told["verdict"] == "unknown"
    page.get_by_label("Pictures").set_input_files(pictures / "foreign.jpg")
    expect(answer).to_contain_text(f"{told['decision']:.3f} is below {told['threshold']:.3f}".replace("-", "−"))
    expect(answer.locator("svg.cells line")).to_have_count(15)
    answer.get_by_label("the 15 strongest only").uncheck()
    answer.locator("svg.cells line").nth(15).wait_for(state="attached")


@pytest.mark.thorough
def test_several_pictures_are_queried_one_after_the_other_and_a_bad_one_fails_alone(
    admin: Operator, pictures: Path
) -> None:
    page = admin.go(f"maps/{LAB}/try")
    names = ["known.jpg", "foreign.jpg", "known.bmp", "text.jpg"]
    page.get_by_label("Pictures").set_input_files([pictures / name for name in names])
    rows = page.get_by_role("region", name="Frames", exact=True).get_by_role("row")
    told = {"known.jpg": "recognized", "foreign.jpg": "ambiguous|unknown", "known.bmp": "recognized"}
    for name, text in (told | {"text.jpg": "Not a picture"}).items():
        expect(rows.filter(has_text=name)).to_contain_text(re.compile(text))


DROP = """([selector, base64, name]) => {
  const bytes = Uint8Array.from(atob(base64), (one) => one.charCodeAt(0));
  const data = new DataTransfer();
  data.items.add(new File([bytes], name, { type: "image/jpeg" }));
  const event = (kind) => new DragEvent(kind, { dataTransfer: data, bubbles: true, cancelable: true });
  const target = document.querySelector(selector);
  return ["dragover", "drop"].map((kind) => target.dispatchEvent(event(kind)));
}"""


def test_a_picture_that_is_dropped_beside_the_box_is_asked_and_never_shown_instead(
    admin: Operator, pictures: Path
) -> None:
    file = base64.b64encode((pictures / "known.jpg").read_bytes()).decode()
    page = admin.go("maps")
    assert page.evaluate(DROP, ["main", file, "known.jpg"]) == [False, False], "the browser would leave the page"
    page = admin.go(f"maps/{LAB}/try")
    assert page.evaluate(DROP, ["h1", file, "known.jpg"]) == [False, False]
    page.get_by_role("region", name="Answer").get_by_text("recognized").wait_for()


def test_the_stages_of_an_answer_add_up(admin: Operator, pictures: Path) -> None:
    page = admin.go(f"maps/{LAB}/try")
    page.get_by_label("Pictures").set_input_files(pictures / "known.jpg")
    page.get_by_role("region", name="Answer").wait_for()
    written = page.locator(".stages .number").all_inner_texts()
    *stages, total = [float(text.removesuffix(" ms")) for text in written]
    assert len(stages) > 2 and sum(stages) == pytest.approx(total, abs=0.5 * len(written))


def test_the_pictures_of_frames_that_are_cleared_are_given_up(admin: Operator, pictures: Path) -> None:
    page = admin.go(f"maps/{LAB}/try")
    page.evaluate("""() => {
        window.living = new Set();
        const { createObjectURL, revokeObjectURL } = URL;
        URL.createObjectURL = (blob) => {
            const url = createObjectURL(blob);
            if (blob instanceof File) living.add(url);  // others are pictures of places
            return url;
        };
        URL.revokeObjectURL = (url) => { living.delete(url); revokeObjectURL(url); };
    }""")
    page.get_by_label("Pictures").set_input_files([pictures / "foreign.jpg", pictures / "text.jpg"])
    rows = page.get_by_role("region", name="Frames", exact=True).get_by_role("row")
    page.get_by_text("Not a picture").wait_for()
    expect(rows).to_have_count(3)
    assert eventually(lambda: page.evaluate("living.size") == 1)
    page.get_by_role("button", name="Clear").click()
    assert eventually(lambda: page.evaluate("living.size") == 0)


@pytest.mark.thorough
def test_the_request_as_curl_does_the_same(admin: Operator, keys: dict[str, str], pictures: Path) -> None:
    page = admin.go(f"maps/{LAB}/try")
    page.get_by_label("Pictures").set_input_files(pictures / "known.jpg")
    page.get_by_role("region", name="Answer").wait_for()
    text = page.get_by_label("The same request", exact=True).inner_text()
    assert keys["admin"] not in text
    if not Path("/usr/bin/curl").exists():
        pytest.skip("no curl is installed")
    environment = {"PLACEREC_KEY": keys["admin"], "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        ["bash", "-c", text], cwd=pictures, env=environment, capture_output=True, text=True, check=True
    )
    assert '"verdict":"recognized"' in done.stdout
    assert shlex.split(text.replace("\\\n", ""))[0] == "curl"


@pytest.mark.thorough
def test_frames_of_the_webcam_are_queried(admin: Operator) -> None:
    page = admin.go(f"maps/{LAB}/try")
    page.get_by_role("button", name="Use the webcam").click()
    page.get_by_role("button", name="Ask with this frame").click()
    page.get_by_role("region", name="Answer").locator(".verdict").wait_for()
    page.get_by_role("button", name="Stop").click()
    page.get_by_text("Drop pictures here").wait_for()


@pytest.mark.thorough
def test_live_answers_appear_and_are_explained_by_one_click(admin: Operator, keyed: Server) -> None:
    page = admin.go(f"maps/{LAB}/live")
    page.get_by_label("frames as thumbnails").check()
    page.get_by_text("listening").wait_for()
    keyed.query(LAB, frame_again(4))
    lines = page.get_by_role("list", name="Answers").get_by_role("listitem")
    lines.first.get_by_text("recognized").wait_for()
    expect(lines.first).to_contain_text(re.compile(r"(mon|tues)day-04"))
    expect(lines.first).to_contain_text(re.compile(r"^\s*\d\d:\d\d:\d\d\s*admin-key"))
    lines.first.get_by_role("img", name="The frame").wait_for()
    lines.first.get_by_role("button", name="Why").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_text("Decision value").wait_for()
    dialog.get_by_role("button", name=re.compile("Ask again")).click()
    page.get_by_role("region", name="Answer").get_by_text("recognized").wait_for()


def test_live_answers_name_the_frame_alone_and_the_run_and_say_what_was_tried_in_a_console(
    admin: Operator, keyed: Server
) -> None:
    page = admin.go(f"maps/{LAB}/live")
    page.get_by_text("listening").wait_for()
    session = keyed.client.post(f"/v1/maps/{LAB}/sessions", json={}).json()["id"]
    path, kind = f"/v1/maps/{LAB}/sessions/{session}/frames", {"Content-Type": "image/jpeg"}
    told = keyed.client.post(path, content=foreign_frame(2100), headers=kind).json()
    line = page.get_by_role("list", name="Answers").get_by_role("listitem").first
    expect(line).to_contain_text(
        re.compile(rf"{told['single']['verdict']}\s*this frame alone\s*.*{told['verdict']}\s*the run")
    )
    line.get_by_role("button", name="Why").click()
    expect(page.get_by_role("dialog")).to_contain_text(re.compile("this frame alone.*the run"))
    page.keyboard.press("Escape")
    tried = {**kind, "X-Placerec-Console": "1"}
    keyed.client.post(f"/v1/maps/{LAB}/query", content=frame_again(4), headers=tried).raise_for_status()
    expect(line).to_contain_text("tried in a console, not counted")
    expect(line).not_to_contain_text("the run")
    keyed.client.delete(f"/v1/maps/{LAB}/sessions/{session}")


@pytest.mark.thorough
def test_a_question_is_asked_again_with_its_filters(admin: Operator, keyed: Server) -> None:
    page = admin.go(f"maps/{LAB}/live")
    page.get_by_label("frames as thumbnails").check()
    page.get_by_text("listening").wait_for()
    filters = {"sequences": "tuesday", "where": '{"floor": 2}', "x": "0", "y": "0", "radius": "500"}
    told = keyed.client.post(
        f"/v1/maps/{LAB}/query", params=filters, content=frame_again(4), headers={"Content-Type": "image/jpeg"}
    )
    assert told.status_code == 200
    lines = page.get_by_role("list", name="Answers").get_by_role("listitem")
    lines.first.get_by_role("button", name="Why").click()
    with page.expect_request(lambda request: request.method == "POST") as asked:
        page.get_by_role("dialog").get_by_role("button", name=re.compile("Ask again")).click()
    sent = dict(parse_qsl(urlsplit(asked.value.url).query))
    assert filters.items() <= {name: value.removesuffix(".0") for name, value in sent.items()}.items()
    page.get_by_role("group", name="Filters of the question").get_by_text("sequences = tuesday").wait_for()
    matches = page.get_by_role("region", name="Matches").get_by_role("listitem")
    expect(matches).to_contain_text(["tuesday-04"] + ["tuesday"] * 4)
    page.get_by_role("button", name="Drop them").click()
    expect(page.get_by_label("The same request", exact=True)).not_to_contain_text("sequences")


@pytest.mark.thorough
def test_live_answers_are_paused_and_filtered(admin: Operator, keyed: Server) -> None:
    page = admin.go(f"maps/{LAB}/live")
    page.get_by_text("listening").wait_for()
    lines = page.get_by_role("list", name="Answers").get_by_role("listitem")
    page.get_by_role("button", name="Pause").click()
    keyed.query(LAB, frame_again(5))
    page.get_by_role("button", name="Go on (1 new)").wait_for()
    expect(lines).to_have_count(0)
    page.get_by_role("button", name="Go on").click()
    lines.first.wait_for()
    page.get_by_label("Who, camera, place").fill("nobody")
    page.get_by_text("No queries yet").wait_for()
    page.get_by_label("Who, camera, place").fill("ADMIN")
    lines.first.wait_for()
    page.get_by_role("button", name="recognized", exact=True).click()
    page.get_by_text("listening").wait_for()
    keyed.query(LAB, frame_again(6))
    answer = keyed.query(LAB, foreign_frame(2000))
    page.get_by_role("list", name="Answers").get_by_text(answer["verdict"]).first.wait_for()
    expect(lines).to_have_count(2)


@pytest.mark.thorough
def test_a_query_key_sees_live_answers_without_frames_and_names(visit: Visit, keyed: Server) -> None:
    page = visit("query").go(f"maps/{LAB}/live")
    page.get_by_text("listening").wait_for()
    keyed.query(LAB, frame_again(7))
    line = page.get_by_role("list", name="Answers").get_by_role("listitem").first
    line.get_by_text("recognized").wait_for()
    expect(line).not_to_contain_text("admin-key")
    expect(page.get_by_label("frames as thumbnails")).to_have_count(0)


@pytest.mark.thorough
def test_a_robot_is_drawn_where_its_session_is(admin: Operator, keyed: Server) -> None:
    page = admin.go(f"maps/{LAB}/plan")
    session = keyed.client.post(f"/v1/maps/{LAB}/sessions", json={}).json()["id"]
    for number in (2, 3, 4):
        frame = encoded(seen_again(scene(number), seed=80 + number))
        path = f"/v1/maps/{LAB}/sessions/{session}/frames"
        assert keyed.client.post(path, content=frame, headers={"Content-Type": "image/jpeg"}).status_code == 200
    robots = page.get_by_role("list", name="Robots")
    robots.get_by_text("admin-key").wait_for()  # robots are known by their keys
    expect(robots.get_by_title(session)).to_have_count(1)
    admin.foresee(f"sessions/{session}")  # the page may be reading it
    keyed.client.delete(f"/v1/maps/{LAB}/sessions/{session}")
    robots.wait_for(state="detached")


@pytest.mark.thorough
def test_a_robot_that_is_silent_is_not_shown_as_recognized(visit: Visit, keyed: Server, keys: dict[str, str]) -> None:
    session = keyed.client.post(f"/v1/maps/{LAB}/sessions", json={}).json()["id"]

    def send(number: int) -> None:
        frame = encoded(seen_again(scene(number), seed=90 + number))
        path = f"/v1/maps/{LAB}/sessions/{session}/frames"
        assert keyed.client.post(path, content=frame, headers={"Content-Type": "image/jpeg"}).status_code == 200

    for number in (2, 3, 4):
        send(number)
    begun_by = []
    for role in ("enrol", "query"):
        headers = {"Authorization": f"Bearer {keys[role]}"}
        (told,) = keyed.client.get(f"/v1/maps/{LAB}/sessions", headers=headers).json()["items"]
        begun_by.append(told["key"])
    assert begun_by == ["admin-key", None]
    operator = visit("admin", alone=True)
    page = operator.page
    page.clock.install()
    operator.go(f"maps/{LAB}/plan")
    heard = page.get_by_role("list", name="Robots", exact=True).get_by_text("recognized")

    def is_heard() -> bool:
        """Whether it is; it may have been silent for ten seconds by the time that the page was there."""
        send(5)
        return heard.is_visible()

    assert eventually(is_heard)
    page.clock.fast_forward("09:30")
    silent = page.get_by_role("list", name="Silent robots").get_by_role("listitem")
    expect(silent).to_have_count(1)
    expect(silent).to_contain_text(re.compile("admin-key.*seen 9 min ago"))
    expect(silent).not_to_contain_text("recognized")
    expect(page.get_by_role("list", name="Robots", exact=True)).to_have_count(0)
    operator.go("jobs")
    operator.go(f"maps/{LAB}/plan")  # it is silent for who comes later, too
    expect(silent).to_contain_text(re.compile("admin-key.*seen 9 min ago"))
    operator.foresee(f"sessions/{session}")  # the page may be reading it
    keyed.client.delete(f"/v1/maps/{LAB}/sessions/{session}")
