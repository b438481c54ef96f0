"""What is done with maps and places in the console, and what the service then has."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.service.console.conftest import Operator, Visit
from tests.service.console.world import LAB, PLACES, frame, pose_of
from tests.service.server import Server
from tests.service.wire import eventually

_numbers = itertools.count()


@pytest.fixture
def spare(keyed: Server) -> str:
    """A map of four places that a test may spoil."""
    name = f"spare-{next(_numbers)}"
    keyed.create_map(name)
    for number in range(4):
        keyed.enrol(
            name, f"p{number}", frame(number), **pose_of(number), sequence="walk", metadata={"floor": number % 2}
        )
    return name


def test_the_list_tells_how_large_a_map_is_and_how_it_answers(admin: Operator) -> None:
    page = admin.go("maps")
    row = page.get_by_role("row").filter(has=page.get_by_role("link", name=LAB, exact=True))
    expect(row).to_contain_text(str(2 * PLACES))
    expect(row).to_contain_text("m-region-vlad")
    mix = re.compile(r"\d+ recognized, \d+ ambiguous, \d+ unknown")
    expect(row.locator(".mix")).to_have_attribute("aria-label", mix)
    expect(row.locator("time")).to_have_attribute("title", re.compile("UTC$"))


@pytest.mark.thorough
def test_a_map_is_created_edited_and_deleted(admin: Operator, keyed: Server) -> None:
    page = admin.go("maps")
    page.get_by_role("button", name="Create a map").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Id").fill("made-here")
    dialog.get_by_label("Description").fill("by night")
    dialog.get_by_label("Same place, metres").fill("2.5")
    dialog.get_by_role("button", name="Create").click()
    page.get_by_role("link", name="made-here").wait_for()
    made = keyed.client.get("/v1/maps/made-here").json()
    assert (made["description"], made["same_place_radius"]) == ("by night", 2.5)

    admin.manage("made-here", "Edit")
    page.get_by_role("dialog").get_by_label("Kept of each frame").select_option("none")
    page.get_by_role("button", name="Save").click()
    page.get_by_role("dialog").wait_for(state="detached")
    edited = keyed.client.get("/v1/maps/made-here").json()
    assert (edited["keep"], edited["description"], edited["revision"]) == ("none", "by night", made["revision"] + 1)

    admin.manage("made-here", "Delete")
    button = page.get_by_role("dialog").get_by_role("button", name="Delete the map")
    expect(button).to_be_disabled()
    page.get_by_role("dialog").get_by_role("textbox").fill("made-her")
    expect(button).to_be_disabled()
    page.get_by_role("dialog").get_by_role("textbox").fill("made-here")
    button.click()
    page.get_by_role("link", name="made-here").wait_for(state="detached")
    assert keyed.client.get("/v1/maps/made-here").status_code == 404


def test_a_map_that_is_gone_is_no_longer_chosen(admin: Operator, keyed: Server) -> None:
    keyed.create_map("passing")
    page = admin.go("maps/passing/plan")
    choice = page.locator(".map-choice select")
    expect(choice).to_have_value("passing")
    page.get_by_role("link", name="Maps", exact=True).click()
    page.get_by_role("link", name="Places", exact=True).wait_for()
    admin.manage("passing", "Delete")
    page.get_by_role("dialog").get_by_role("textbox").fill("passing")
    page.get_by_role("dialog").get_by_role("button", name="Delete the map").click()
    expect(choice).to_have_value("")
    expect(choice.get_by_role("option", name="passing")).to_have_count(0)
    expect(page.get_by_role("link", name="Places", exact=True)).to_have_count(0)


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["phone", "laptop"])
def test_a_long_description_leaves_the_actions_in_view(visit: Visit, keyed: Server, size: str) -> None:
    name = f"described-{size}"
    keyed.create_map(name, description="by day and by night, " * 60)
    operator = visit("admin", size=size)
    page = operator.go("maps")
    button = page.get_by_role("button", name=f"Actions for {name}")
    box = button.bounding_box()
    assert box is not None and box["x"] >= 0 and box["x"] + box["width"] <= page.evaluate("innerWidth")
    button.click()
    expect(page.get_by_role("button", name=f"Delete {name}")).to_be_in_viewport(ratio=0.95)
    page.get_by_role("button", name=f"Delete {name}").click()
    page.get_by_role("dialog", name=f"Delete {name}").wait_for()
    operator.leave()
    keyed.client.delete(f"/v1/maps/{name}")


@pytest.mark.thorough
def test_an_edit_over_another_change_is_refused_and_explained(admin: Operator, keyed: Server, spare: str) -> None:
    page = admin.go("maps")
    admin.manage(spare, "Edit")
    page.get_by_role("dialog").get_by_label("Description").fill("mine")
    keyed.client.patch(f"/v1/maps/{spare}", json={"description": "theirs"})
    admin.foresee("412")
    page.get_by_role("button", name="Save").click()
    told = page.get_by_role("dialog").get_by_role("alert")
    told.get_by_text("The map has changed", exact=False).first.wait_for()
    expect(told).to_contain_text(re.compile(r"Request [0-9a-f]{32}"))
    assert keyed.client.get(f"/v1/maps/{spare}").json()["description"] == "theirs"


@pytest.mark.thorough
def test_a_map_is_exported_and_imported_again(admin: Operator, keyed: Server, spare: str, tmp_path: Path) -> None:
    page = admin.go("maps")
    admin.manage(spare, "Export")
    with page.expect_download() as saved:
        page.get_by_role("dialog").get_by_role("button", name="Export").click()
    file = tmp_path / saved.value.suggested_filename
    saved.value.save_as(file)
    assert file.name == f"{spare}.tar"

    page.get_by_role("button", name="Import").click()
    dialog = page.get_by_role("dialog")
    dialog.locator("input[type=file]").set_input_files(file)
    dialog.get_by_label("Id").fill(f"{spare}-again")
    dialog.get_by_role("button", name="Import").click()
    dialog.wait_for(state="detached")
    page.get_by_role("link", name=f"{spare}-again").wait_for()
    assert keyed.places(f"{spare}-again").keys() == keyed.places(spare).keys()


def test_a_file_that_is_no_map_is_refused_in_the_dialog(admin: Operator, tmp_path: Path) -> None:
    (tmp_path / "no-map.tar").write_bytes(b"no map" * 1000)
    page = admin.go("maps")
    page.get_by_role("button", name="Import").click()
    page.locator("input[type=file]").set_input_files(tmp_path / "no-map.tar")
    admin.foresee("422", "400")
    page.get_by_role("dialog").get_by_role("button", name="Import").click()
    page.get_by_role("dialog").get_by_role("alert").get_by_text("Request", exact=False).wait_for()


@pytest.mark.thorough
def test_places_are_filtered(admin: Operator) -> None:
    page = admin.go(f"maps/{LAB}/places")
    tiles = page.get_by_role("list", name="Places").get_by_role("listitem")
    expect(tiles).to_have_count(2 * PLACES)
    page.get_by_label("Traverse").select_option("monday")
    page.wait_for_url("**sequence=monday")
    expect(tiles).to_have_count(PLACES)
    page.get_by_label("Traverse").select_option("")
    page.get_by_label("Metadata").fill("light = dusk, floor = 2")
    page.get_by_label("Metadata").press("Enter")
    page.wait_for_url("**where=**")
    expect(tiles).to_contain_text(["tuesday"] * PLACES)
    page.get_by_label("Metadata").fill("floor = 3")
    page.get_by_label("Metadata").press("Enter")
    page.get_by_text("No place fits the filters.").wait_for()
    page.get_by_role("button", name="Clear").click()
    page.get_by_label("Taken from (UTC)").fill("2026-11-17T10:00:06")
    page.wait_for_url("**after=**")
    expect(tiles).to_have_count(PLACES - 6)


def test_a_number_is_looked_for_as_a_text_where_it_is_one(admin: Operator, keyed: Server) -> None:
    keyed.create_map("written")
    for number, floor in enumerate((2, "2")):
        keyed.enrol("written", f"p{number}", frame(number), metadata={"floor": floor, "house": f"h{number}"})
    page = admin.go("maps/written/places")
    tiles = page.get_by_role("list", name="Places").get_by_role("listitem")
    page.get_by_label("Metadata").fill("floor = 2, house = h1")
    page.get_by_label("Metadata").press("Enter")
    page.get_by_text("No place fits the filters.").wait_for()
    page.get_by_role("button", name='Look for floor = "2", house = h1').click()
    expect(tiles).to_contain_text(["p1"])
    expect(page.get_by_label("Metadata")).to_have_value('floor = "2", house = h1')


@pytest.mark.thorough
def test_places_come_in_pages(admin: Operator, keyed: Server) -> None:
    keyed.create_map("paged", verification=False)
    for number in range(61):
        assert keyed.enrol("paged", f"q{number:02d}", frame(number % 3)).status_code == 201
    page = admin.go("maps/paged/places")
    tiles = page.get_by_role("list", name="Places").get_by_role("listitem")
    expect(tiles).to_have_count(60)
    page.get_by_role("button", name="Next").click()
    page.get_by_role("link", name="q60").wait_for()
    expect(tiles).to_have_count(1)
    page.get_by_role("button", name="Before").click()
    page.get_by_role("link", name="q00").wait_for()


@pytest.mark.thorough
def test_a_place_is_shown_with_its_picture_neighbours_and_what_matched_it(admin: Operator) -> None:
    page = admin.go(f"maps/{LAB}/places/monday-03")
    picture = page.get_by_role("img", name="Place monday-03").first
    assert picture.evaluate("one => one.decode().then(() => one.naturalWidth)") > 100
    along = page.locator("section").filter(has=page.get_by_role("heading", name="Along the traverse"))
    expect(along.get_by_role("listitem")).to_contain_text([f"monday-{number:02d}" for number in range(7)])
    near = page.locator("section").filter(has=page.get_by_role("heading", name="Nearest by pose"))
    expect(near.get_by_role("listitem").first).to_contain_text("tuesday-03")
    page.get_by_role("heading", name="Recent matches").wait_for()
    page.get_by_role("region", name="Answers").get_by_role("row").nth(1).wait_for()


@pytest.mark.thorough
def test_a_place_is_edited_and_the_edit_undone(admin: Operator, keyed: Server, spare: str) -> None:
    before = keyed.client.get(f"/v1/maps/{spare}/places/p1").json()
    page = admin.go(f"maps/{spare}/places/p1")
    page.get_by_role("button", name="Edit").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("x", exact=True).fill("4.25")
    dialog.get_by_label("Traverse").fill("drive")
    dialog.get_by_label("Metadata").fill('{"door": "open"}')
    dialog.get_by_role("button", name="Save").click()
    dialog.wait_for(state="detached")
    edited = keyed.client.get(f"/v1/maps/{spare}/places/p1").json()
    assert (edited["pose"]["x"], edited["sequence"], edited["metadata"]) == (4.25, "drive", {"door": "open"})
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("link", name="walk").first.wait_for()
    after = keyed.client.get(f"/v1/maps/{spare}/places/p1").json()
    assert {**after, "updated_at": None} == {**before, "updated_at": None}


@pytest.mark.thorough
def test_metadata_that_is_no_json_is_refused_before_it_is_sent(admin: Operator, spare: str) -> None:
    page = admin.go(f"maps/{spare}/places/p1")
    page.get_by_role("button", name="Edit").click()
    page.get_by_label("Metadata").fill("{floor: 2")
    page.get_by_role("button", name="Save").click()
    page.get_by_role("dialog").get_by_text("Write the metadata as a JSON object.").wait_for()


@pytest.mark.thorough
def test_one_place_is_deleted_by_its_name(admin: Operator, keyed: Server, spare: str) -> None:
    page = admin.go(f"maps/{spare}/places/p2")
    admin.foresee(f"{spare}/places/p2/")  # its pictures may still be on their way
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("textbox").fill("p2")
    page.get_by_role("button", name="Delete the place").click()
    page.wait_for_url("**/places")
    assert "p2" not in keyed.places(spare)


@pytest.mark.thorough
@pytest.mark.parametrize("way", ["chosen", "filtered"])
def test_many_places_are_deleted_together(visit: Visit, keyed: Server, spare: str, way: str) -> None:
    operator = visit("enrol")
    page = operator.go(f"maps/{spare}/places")
    expect(page.locator(".picture.waiting")).to_have_count(0)
    if way == "chosen":
        page.get_by_label("Choose p1").check()
        page.get_by_label("Choose p3").check()
        page.get_by_role("button", name="Delete 2 chosen").click()
    else:
        page.get_by_label("Metadata").fill("floor = 1")
        page.get_by_label("Metadata").press("Enter")
        page.get_by_role("button", name="Delete all of these").click()
    dialog = page.get_by_role("dialog", name="Delete 2 places")
    for name in ("p1", "p3"):
        expect(dialog).to_contain_text(name)
    assert len(keyed.places(spare)) == 4
    dialog.get_by_role("textbox").fill(spare)
    dialog.get_by_role("button", name="Delete", exact=True).click()
    dialog.wait_for(state="detached")
    assert keyed.places(spare).keys() == {"p0", "p2"}


@pytest.mark.thorough
def test_the_plan_chooses_what_is_clicked_and_goes_along_the_traverse(admin: Operator) -> None:
    page = admin.go(f"maps/{LAB}/plan")
    canvas = page.get_by_role("img", name=re.compile(f"Plan of {LAB}"))
    page.get_by_label("Find a place").fill("monday-04")
    page.get_by_role("button", name="Find", exact=True).click()
    chosen = page.get_by_role("region", name="Chosen place")
    chosen.get_by_role("link", name="monday-04").wait_for()
    canvas.focus()
    page.keyboard.press("n")
    chosen.get_by_role("link", name="monday-05").wait_for()
    box = canvas.bounding_box()
    assert box is not None
    for _ in range(5):
        page.keyboard.press("+")
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 30)
    page.get_by_role("region", name="Chosen place").wait_for(state="detached")
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    chosen.get_by_role("link", name="monday-05").wait_for()


@pytest.mark.thorough
def test_traverses_are_drawn_in_their_colours_and_can_be_left_out(admin: Operator) -> None:
    page = admin.go(f"maps/{LAB}/plan")
    count = """canvas => {
      const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', { willReadFrequently: true });
      copy.drawImage(canvas, 0, 0);
      const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
      let found = 0;
      for (let one = 3; one < data.length; one += 4) found += data[one] > 200;
      return found;
    }"""

    def painted() -> int:
        found: int = page.locator(".plan-canvas canvas.places").evaluate(count)
        return found

    assert eventually(lambda: painted() > 100)
    both = painted()
    page.get_by_label("monday").uncheck()
    assert eventually(lambda: 100 < painted() < both)
    page.get_by_label("tuesday").uncheck()
    assert eventually(lambda: painted() == 0)


@pytest.mark.thorough
def test_without_poses_the_traverses_are_strips(admin: Operator, keyed: Server) -> None:
    keyed.create_map("unposed")
    for number in range(3):
        keyed.enrol("unposed", f"u{number}", frame(number), sequence="walk")
    page = admin.go("maps/unposed/plan")
    page.get_by_text("no poses: each traverse is a strip").wait_for()
    page.get_by_text("1 frame", exact=True).wait_for()
    page.get_by_label("Find a place").fill("u2")
    page.get_by_role("button", name="Find", exact=True).click()
    page.get_by_role("region", name="Chosen place").get_by_role("link", name="u2").wait_for()
