"""Frames kept for review in the console, and an operator's day from a doubtful answer to a better calibration."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.service.console import world
from tests.service.console.conftest import OUT_OF_PANEL, Operator, Visit
from tests.service.learning.test_lessons import CORRIDOR, lessons
from tests.service.learning.test_new_ground import drive, gapped, waiting
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server
from tests.service.wire import eventually

KEPT = {"verdicts": ["recognized", "ambiguous", "unknown"], "most_frames": 500, "most_bytes": 2**28}


def wait_for_kept(server: Server, map_id: str, count: int) -> None:
    """Frames are written a moment after their answers."""
    assert eventually(lambda: server.client.get(f"/v1/maps/{map_id}/review").json()["frames"] >= count)


@pytest.fixture
def doubtful(keyed: Server, request: pytest.FixtureRequest) -> str:
    """A map of four places that keeps every frame, and has three: of places 0 and 1, and of none."""
    name = f"doubtful-{re.sub('[^a-z]+', '-', request.node.name.lower())[-30:]}".strip("-")
    keyed.create_map(name)
    for number in range(4):
        keyed.enrol(name, f"p{number}", world.frame(number), sequence="walk", **world.pose_of(number))
    keyed.client.patch(f"/v1/maps/{name}", json={"review": KEPT})
    for data in (world.frame_again(0), world.frame_again(1), jpeg(500)):
        keyed.query(name, data)
    wait_for_kept(keyed, name, 3)
    return name


def test_an_admin_says_which_frames_are_stored(admin: Operator, keyed: Server) -> None:
    keyed.create_map("keeping")
    page = admin.go("maps/keeping/review")
    page.get_by_text("This map stores no frames for review now.").wait_for()
    page.get_by_role("button", name="Stored frames").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("ambiguous").check()
    dialog.get_by_label("unknown").check()
    dialog.get_by_label("At most, frames").fill("50")
    dialog.get_by_role("button", name="Save").click()
    page.get_by_text("This map stores no frames for review now.").wait_for(state="detached")
    kept = keyed.client.get("/v1/maps/keeping").json()["review"]
    assert sorted(kept["verdicts"]) == ["ambiguous", "unknown"] and kept["most_frames"] == 50


@pytest.mark.thorough
def test_frames_are_labelled_in_every_way(visit: Visit, keyed: Server, doubtful: str, tmp_path: Path) -> None:
    operator = visit("enrol")
    page = operator.go(f"maps/{doubtful}/review")
    queue = page.get_by_role("list", name="Frames").get_by_role("listitem")
    expect(queue).to_have_count(3)
    panel = page.get_by_role("region", name="Frame to be labelled")
    assert (
        panel.get_by_role("img", name="The frame").evaluate("one => one.decode().then(() => one.naturalWidth)") == 320
    )

    panel.get_by_role("button", name="Enrol it").click()  # the newest first: the frame of no place
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Id").fill("p9")
    dialog.get_by_label("x", exact=True).fill("30")
    dialog.get_by_label("y", exact=True).fill("4")
    dialog.get_by_role("button", name="Enrol").click()
    page.get_by_text("Enrolled as p9.").wait_for()
    assert keyed.client.get(f"/v1/maps/{doubtful}/places/p9").json()["pose"]["x"] == 30
    panel.get_by_role("button", name="It is p1").click()
    page.get_by_text("2 labelled").wait_for()
    panel.get_by_role("button", name="Another place").click()
    page.get_by_role("dialog").get_by_label("Id of the place").fill("p0")
    page.get_by_role("dialog").get_by_role("button", name="Label").click()
    page.get_by_text("Nothing to be looked at").wait_for()

    with page.expect_download() as saved:
        page.get_by_role("button", name="Export the labels").click()
    saved.value.save_as(tmp_path / "labels.json")
    labels = json.loads((tmp_path / "labels.json").read_text())["items"]
    assert sorted(one["place"] for one in labels) == ["p0", "p1", "p9"]

    page.get_by_role("button", name="Labelled").click()
    page.get_by_role("button", name="No place of this map").click()  # a label can be replaced
    page.get_by_text("Labelled: no place of this map.").first.wait_for()
    again = keyed.client.get(f"/v1/maps/{doubtful}/review/labels").json()["items"]
    assert sum(one["place"] is None for one in again) == 1


@pytest.mark.thorough
def test_frames_that_come_wait_until_they_are_wanted(admin: Operator, keyed: Server, doubtful: str) -> None:
    page = admin.go(f"maps/{doubtful}/review")
    queue = page.get_by_role("list", name="Frames").get_by_role("listitem")
    expect(queue).to_have_count(3)
    panel = page.get_by_role("region", name="Frame to be labelled")
    request = panel.locator("code").inner_text()
    for number in (2, 3):
        keyed.query(doubtful, world.frame_again(number))
    wait_for_kept(keyed, doubtful, 5)
    more = page.get_by_role("button", name="Show 2 new")
    more.wait_for()
    expect(queue).to_have_count(3)
    expect(panel.locator("code")).to_have_text(request)
    panel.get_by_role("button", name="No place of this map").click()
    page.get_by_text("Labelled: no place of this map.").wait_for()
    labelled = keyed.client.get(f"/v1/maps/{doubtful}/review?labelled=true").json()["items"]
    assert [one["answer"]["request_id"] for one in labelled] == [request], "what was shown was labelled"
    more.click()
    expect(queue).to_have_count(4)
    expect(panel.locator("code")).not_to_have_text(request)


def test_a_label_is_given_by_a_number_and_taken_back(admin: Operator, keyed: Server, doubtful: str) -> None:
    page = admin.go(f"maps/{doubtful}/review")
    panel = page.get_by_role("region", name="Frame to be labelled")
    request = panel.locator("code")
    first = request.inner_text()
    second = panel.get_by_role("link").nth(1).inner_text()
    page.keyboard.press("2")
    page.get_by_text(f"Labelled as {second}.").wait_for()
    expect(request).not_to_have_text(first)

    def labels() -> list[str | None]:
        told = keyed.client.get(f"/v1/maps/{doubtful}/review/labels").json()["items"]
        return [one["place"] for one in told]

    assert labels() == [second]
    page.get_by_role("button", name="Undo").click()
    expect(request).to_have_text(first)
    assert labels() == []

    panel.get_by_role("button", name="Enrol it").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Id").fill("p9")
    page.keyboard.press("1")  # into the field: nothing is labelled
    expect(dialog.get_by_label("Id")).to_have_value("p91")
    dialog.get_by_role("button", name="Enrol").click()
    page.get_by_text("Enrolled as p91.").wait_for()
    assert "p91" in keyed.places(doubtful)
    page.get_by_role("button", name="Undo").click()
    expect(request).to_have_text(first)
    assert labels() == [] and "p91" not in keyed.places(doubtful)


def test_a_second_click_does_not_label_the_next_frame(admin: Operator, keyed: Server, doubtful: str) -> None:
    page = admin.go(f"maps/{doubtful}/review")
    panel = page.get_by_role("region", name="Frame to be labelled")
    panel.get_by_role("button", name="No place of this map").dblclick()
    page.get_by_text("Labelled: no place of this map.").wait_for()
    expect(page.get_by_role("list", name="Frames").get_by_role("listitem")).to_have_count(2)
    assert len(keyed.client.get(f"/v1/maps/{doubtful}/review/labels").json()["items"]) == 1


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["phone", "laptop"])
def test_long_ids_show_their_ends_and_stay_in_their_cards(visit: Visit, keyed: Server, size: str) -> None:
    name = f"long-{size}"
    keyed.create_map(name, review=KEPT)
    long = "north-wing-second-floor-camera-front-left"
    for number in range(5):
        place = f"{long}-{'even' if number % 2 == 0 else 'odd'}-{number // 2:06d}"
        keyed.enrol(name, place, world.frame(number), sequence="walk", **world.pose_of(number))
    keyed.query(name, world.frame_again(1))
    wait_for_kept(keyed, name, 1)
    page = visit("admin", size=size).go(f"maps/{name}/review")
    cards = page.locator(".matches > li")
    expect(cards).to_have_count(5)
    ends = cards.evaluate_all("""cards => cards.map((card) => {
      const box = card.getBoundingClientRect();
      const inside = (one) => one.right <= box.right + 0.5 && one.left >= box.left - 0.5;
      const ends = [...card.querySelectorAll(".end")];
      const boxes = [...card.children, ...ends].map((one) => one.getBoundingClientRect());
      const whole = ends.every((end) => end.scrollWidth <= end.clientWidth);
      return [ends.map((end) => end.textContent), boxes.every(inside) && whole];
    })""")
    distinct = [f"{kind}-{number:06d}" for kind, count in (("even", 3), ("odd", 2)) for number in range(count)]
    assert sorted(texts for texts, _ in ends) == [[end] * 2 for end in distinct], "what they have not in common"
    assert all(inside for _, inside in ends)
    assert page.evaluate(OUT_OF_PANEL) == []


@pytest.mark.thorough
def test_a_frame_that_is_thrown_away_can_be_taken_back_for_a_while(
    admin: Operator, keyed: Server, doubtful: str
) -> None:
    page = admin.go(f"maps/{doubtful}/review")
    queue = page.get_by_role("list", name="Frames").get_by_role("listitem")
    page.get_by_role("button", name="Throw away").click()
    page.get_by_text("The frame is thrown away.").wait_for()
    expect(queue).to_have_count(2)
    page.get_by_role("button", name="Undo").click()
    page.get_by_text("The frame is thrown away.").wait_for(state="detached")
    expect(queue).to_have_count(3)
    page.get_by_role("button", name="Throw away").click()
    with page.expect_response(lambda answer: answer.request.method == "POST") as gone:
        page.get_by_role("link", name="Places").click()  # whoever goes on means it
    assert gone.value.ok
    page.get_by_role("heading", name="Places").wait_for()
    admin.settle()
    assert keyed.client.get(f"/v1/maps/{doubtful}/review").json()["frames"] == 2


@pytest.mark.thorough
def test_an_operators_day(admin: Operator, keyed: Server, tmp_path: Path) -> None:
    # A map comes from elsewhere: imported in the console.
    exported = keyed.client.get(f"/v1/maps/{world.LAB}/export").content
    (tmp_path / "day.tar").write_bytes(exported)
    page = admin.go("maps")
    page.get_by_role("button", name="Import").click()
    dialog = page.get_by_role("dialog")
    dialog.locator("input[type=file]").set_input_files(tmp_path / "day.tar")
    dialog.get_by_label("Id").fill("day")
    dialog.get_by_role("button", name="Import").click()
    dialog.wait_for(state="detached")

    # It is told to keep what it is not sure of; robots ask.
    keyed.client.patch("/v1/maps/day", json={"review": KEPT})
    asked = [encoded(seen_again(scene(number), seed=200 + number)) for number in range(world.PLACES)]
    asked += [world.foreign_frame(3000 + number) for number in range(world.PLACES)]
    stated = [keyed.query("day", data)["probability"] for data in asked]
    wait_for_kept(keyed, "day", len(asked))

    # Each frame is labelled: by its best match where that is right, as a stranger otherwise.
    page = admin.go("maps/day/review")
    frames = keyed.client.get("/v1/maps/day/review?limit=100").json()["items"]
    first = frames[0]
    page.get_by_role("button", name=f"Frame {first['id']}").click()
    page.get_by_role("button", name="No place of this map").click()
    page.get_by_text("Labelled: no place of this map.").wait_for()
    for position, frame in enumerate(frames[1:], start=1):
        number = len(asked) - 1 - position
        label = {"place": frame["answer"]["best"]} if number < world.PLACES else {"stranger": True}
        assert keyed.client.post(f"/v1/maps/day/review/{frame['id']}", json=label).status_code == 200

    # The labels calibrate the map.
    page = admin.go("maps/day/calibration")
    before = page.get_by_text("encoder-default")
    before.wait_for()
    page.get_by_role("button", name="Calibrate", exact=True).click()
    dialog.get_by_label("Ask").select_option("labels")
    dialog.get_by_label("Dry run").uncheck()
    dialog.get_by_role("button", name="Calibrate", exact=True).click()
    dialog.wait_for(state="detached")
    page.get_by_text("labels: ", exact=False).wait_for()
    before.wait_for(state="detached")
    page.get_by_role("img", name=re.compile("Reliability diagram")).wait_for()
    assert keyed.client.get("/v1/maps/day").json()["calibration"]["source"] == "labels"

    # The frame that was least certain is now as probable as the labels say.
    doubted = min(range(len(asked)), key=lambda number: abs(stated[number] - 0.5))
    (tmp_path / "frame.jpg").write_bytes(asked[doubted])
    page = admin.go("maps/day/try")
    page.get_by_label("Pictures").set_input_files(tmp_path / "frame.jpg")
    answer = page.get_by_role("region", name="Answer")
    answer.locator(".verdict").first.wait_for()
    now = keyed.query("day", asked[doubted])["probability"]
    assert f"{now:.1%}" != f"{stated[doubted]:.1%}"
    expect(answer).to_contain_text(f"{100 * now:.1f}\u00a0%")

    # It is pruned of what was enrolled twice, and saved.
    for number in range(6):
        pose = world.pose_of(number, 0.2)
        assert keyed.enrol("day", f"again-{number}", world.frame(number), **pose, sequence="again").is_success
    page = admin.go("maps/day/health")
    prune = page.get_by_role("region", name="Prune")
    prune.get_by_role("slider").fill("10")
    prune.get_by_role("button", name="Preview the loss").click()
    prune.get_by_role("button", name=re.compile(r"Delete \d+ places")).click()
    dialog.get_by_role("textbox").fill("day")
    dialog.get_by_role("button", name="Delete the places").click()
    prune.get_by_text("Gone").wait_for()
    page = admin.go("maps")
    admin.manage("day", "Export")
    with page.expect_download() as saved:
        dialog.get_by_role("button", name="Export").click()
    assert Path(saved.value.path()).stat().st_size > 10_000


def test_labels_given_quickly_are_one_message_that_takes_all_back(
    admin: Operator, keyed: Server, doubtful: str
) -> None:
    page = admin.go(f"maps/{doubtful}/review")
    queue = page.get_by_role("list", name="Frames").get_by_role("listitem")
    expect(queue).to_have_count(3)
    request = page.get_by_role("region", name="Frame to be labelled").locator("code")
    first = request.inner_text()
    for left in (2, 1, 0):
        page.keyboard.press("1")
        expect(queue).to_have_count(left)
    told = page.locator(".message")
    expect(told).to_have_count(1)
    expect(told).to_contain_text("3 labelled")
    told.get_by_role("button", name="Undo").click()
    expect(queue).to_have_count(3)
    expect(request).to_have_text(first)
    assert keyed.client.get(f"/v1/maps/{doubtful}/review/labels").json()["items"] == []


def test_a_frame_becomes_a_look_and_is_taken_back(admin: Operator, keyed: Server, doubtful: str) -> None:
    page = admin.go(f"maps/{doubtful}/review")
    panel = page.get_by_role("region", name="Frame to be labelled")
    panel.get_by_role("button", name="A further look of").click()  # the newest: a frame of no place
    page.get_by_text("Added to the looks of").wait_for()
    (look,) = keyed.client.get(f"/v1/maps/{doubtful}/looks").json()["items"]
    page.get_by_role("button", name="Undo").click()
    assert eventually(lambda: keyed.client.get(f"/v1/maps/{doubtful}/looks").json()["items"] == [])
    assert look["place"] in {f"p{number}" for number in range(4)} and look["run"] is None
    left = keyed.client.get(f"/v1/maps/{doubtful}/review", params={"labelled": "true"}).json()["items"]
    assert left == []


def test_a_label_that_is_taken_back_leaves_the_list_of_labels(admin: Operator, keyed: Server, doubtful: str) -> None:
    page = admin.go(f"maps/{doubtful}/review")
    panel = page.get_by_role("region", name="Frame to be labelled")
    panel.get_by_role("button", name="A further look of").click()
    undo = page.get_by_role("button", name="Undo")
    undo.wait_for()
    page.get_by_role("button", name="Labelled", exact=True).click()
    expect(panel).to_contain_text("Added to the looks of")
    undo.click()
    expect(panel).not_to_contain_text("Added to the looks of")
    assert eventually(lambda: keyed.client.get(f"/v1/maps/{doubtful}/looks").json()["items"] == [])


def test_an_admin_says_what_runs_teach(admin: Operator, keyed: Server) -> None:
    keyed.create_map("teaching")
    page = admin.go("maps/teaching/review")
    page.get_by_role("button", name="Stored frames").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("What runs teach").select_option("propose")
    dialog.get_by_role("button", name="Save").click()
    page.get_by_text("This map stores no frames for review now.").wait_for(state="detached")
    read = keyed.client.get("/v1/maps/teaching").json()
    assert read["learning"]["mode"] == "propose" and read["review"] is None


@pytest.mark.thorough
@pytest.mark.skipif(not CORRIDOR.is_dir(), reason="needs the data set eval/corridor")
def test_new_ground_is_accepted_undone_and_rejected_as_one_thing(admin: Operator, keyed: Server) -> None:
    gapped(keyed, "new-ground")
    drive(keyed, "new-ground", 1)
    lessons(keyed, "new-ground")
    (stretch,) = waiting(keyed, "new-ground")
    before = keyed.places("new-ground").keys()
    page = admin.go("maps/new-ground/review")
    page.get_by_text("It is of new ground").wait_for()
    page.get_by_role("button", name="New ground (1)").click()
    title = f"From {stretch['leaves']} to {stretch['returns']}"
    panel = page.get_by_role("region", name=title)
    panel.get_by_text(stretch["why"]).wait_for()
    panel.get_by_role("img", name=f"{title}, on the plan of new-ground.").wait_for()
    first = stretch["frames"][0]
    expect(panel.get_by_role("list", name=f"Frames {title}")).to_contain_text(f"± {first['spread']:.2f} m")
    panel.get_by_role("img", name=f"Frame {first['frame']}", exact=True).wait_for()
    panel.get_by_role("button", name=f"Accept: {len(stretch['frames'])} new places").click()
    accepted = page.get_by_role("region", name="Accepted")
    accepted.get_by_text(f"{len(stretch['frames'])} places in the traverse").wait_for()
    assert keyed.places("new-ground").keys() - before == {one["place"] for one in stretch["frames"]}
    page.get_by_role("button", name="New ground", exact=True).wait_for()
    accepted.get_by_role("button", name="Undo").click()
    page.get_by_text("The places are deleted, and the stretch waits again.").wait_for()
    assert keyed.places("new-ground").keys() == before
    assert [one["id"] for one in waiting(keyed, "new-ground")] == [stretch["id"]]
    panel.get_by_text(stretch["why"]).wait_for()
    page.get_by_role("button", name="Reject …").click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
    assert len(waiting(keyed, "new-ground")) == 1, "it asks first"
    page.get_by_role("button", name="Reject …").click()
    page.get_by_role("dialog").get_by_role("button", name="Reject", exact=True).click()
    page.get_by_text("No new ground waits").wait_for()
    assert waiting(keyed, "new-ground") == []
    learning = "/v1/maps/new-ground"
    assert len(keyed.client.get(learning).json()["learning"]["rejected_ground"]) == 1
    page.get_by_role("button", name=f"Forget that {stretch['id']} was rejected").click()
    page.get_by_text("A run may propose this ground again.").wait_for()
    page.get_by_role("region", name="Rejected ground").wait_for(state="detached")
    assert keyed.client.get(learning).json()["learning"]["rejected_ground"] == []
    admin.leave()
    keyed.client.delete("/v1/maps/new-ground")
