"""Traverses, looks and cameras that operators bring into a map, and their work on all of it."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.core.recordings.bags import CAMERA, ODOMETRY, START, compressed, walk, write_mcap
from tests.service.console import world
from tests.service.console.conftest import Operator, Visit
from tests.service.console.test_plan import thickness
from tests.service.learning.test_lessons import CORRIDOR, drive, lessons, proposals, taught
from tests.service.scenes import scene
from tests.service.server import Server
from tests.service.wire import eventually


def recording(folder: Path, count: int) -> Path:
    """A folder of pictures along a line, half a metre apart, listed from the last to the first."""
    folder.mkdir()
    rows = ["file,x,y,heading,timestamp"]
    for number in range(count):
        (folder / f"f{number}.jpg").write_bytes(world.frame(number))
        rows.insert(1, f"f{number}.jpg,{number / 2},0,90,2026-11-20T10:00:{number:02d}Z")
    (folder / "places.csv").write_text("\ufeff" + "\r\n".join(rows))
    return folder


def test_a_folder_is_enrolled_with_its_poses_and_grows_on_the_plan(visit: Visit, keyed: Server, tmp_path: Path) -> None:
    keyed.create_map("grown")
    folder = recording(tmp_path / "drive", 20)
    (folder / "notes.txt").write_text("nothing to enrol")
    operator = visit("enrol")
    page = operator.go("maps/grown/enrol")
    page.get_by_label("Traverse").fill("monday")
    page.get_by_label("A folder").set_input_files(folder)
    chosen = page.get_by_role("region", name="To enrol")
    expect(chosen).to_contain_text("20 frames")
    page.get_by_label("Traverse").press("Tab")  # what is typed stays while files are read
    expect(chosen).to_contain_text("monday-f19 to monday-f0; all with poses")
    expect(chosen).to_contain_text("Left out: 1 file, neither pictures nor videos")
    page.get_by_label("Metres between two").fill("1")
    expect(chosen).to_contain_text(re.compile("10 frames.*of 20"))
    page.get_by_label("Metres between two").fill("0")
    chosen.get_by_role("button", name="Enrol 20 frames").click()
    expect(chosen.get_by_role("status")).to_have_text("20 of 20: 20 new, 0 replaced, 0 were there.")
    page.get_by_role("img", name=re.compile("The plan of grown: 20 places")).wait_for()
    places = keyed.client.get("/v1/maps/grown/places", params={"limit": 100}).json()["items"]
    assert [one["id"] for one in places] == [f"monday-f{number}" for number in reversed(range(20))]
    assert places[0]["pose"] == {"x": 9.5, "y": 0, "heading": 90} and places[0]["sequence"] == "monday"
    assert places[0]["timestamp"].startswith("2026-11-20T10:00:19")
    sent: list[int] = []
    page.on("request", lambda one: sent.append(len(one.post_data_buffer or b"")) if one.method == "POST" else None)
    chosen.get_by_role("button", name="Enrol 20 frames").click()
    expect(chosen.get_by_role("status")).to_have_text("20 of 20: 0 new, 0 replaced, 20 were there.")
    assert 0 < sum(sent) < 20_000, "frames that are stored are not sent again"


@pytest.mark.thorough
def test_a_video_is_enrolled_by_its_moving_frames(admin: Operator, keyed: Server, tmp_path: Path) -> None:
    keyed.create_map("filmed")
    file = tmp_path / "walk.webm"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"VP80"), 10, (320, 240))
    for shown in (1, 1, 2, 3):  # a second each
        for _ in range(10):
            writer.write(cv2.resize(np.asarray(scene(shown)), (320, 240)))
    writer.release()
    page = admin.go("maps/filmed/enrol")
    page.get_by_label("Pictures, a video or bags").set_input_files(file)
    chosen = page.get_by_role("region", name="To enrol")
    chosen.get_by_role("button", name=re.compile("Enrol [45] frames")).click()
    expect(chosen.get_by_role("status")).to_contain_text("3 new")
    expect(chosen.get_by_role("status")).to_contain_text("left out as nothing had moved")
    places = keyed.client.get("/v1/maps/filmed/places").json()["items"]
    assert [re.sub(".*-", "", one["id"])[:5] for one in places] == ["00000", "00002", "00003"]


@pytest.mark.thorough
def test_a_bag_is_uploaded_and_enrolled_with_chosen_topics(visit: Visit, keyed: Server, tmp_path: Path) -> None:
    keyed.create_map("bagged")
    said = [*walk(), compressed(START, world.frame(9), topic="/rear/compressed")]
    file = write_mcap(tmp_path / "monday.mcap", said)
    operator = visit("enrol")
    page = operator.go("maps/bagged/enrol")
    page.get_by_label("Traverse").fill("monday")
    page.get_by_label("Pictures, a video or bags").set_input_files(file)
    bags = page.get_by_role("region", name="Bags")
    bag = bags.get_by_role("region", name="monday.mcap")
    begin = bag.get_by_role("button", name="Upload and enrol")
    bags.get_by_label("A frame every, metres").fill("-3")
    expect(bags.get_by_role("alert")).to_contain_text("more than 0")
    expect(begin).to_be_disabled()  # it would be refused after the upload
    bags.get_by_label("A frame every, metres").fill("")
    begin.click()
    refusal = bag.get_by_role("alert")
    expect(refusal).to_contain_text(f"{CAMERA}")  # it has two topics of pictures, which are named
    expect(refusal).to_contain_text("Name one with topic.")
    sent: list[str] = []
    page.on("request", lambda one: sent.append(one.method) if "/recordings/" in one.url else None)
    bags.get_by_label("Topic of the pictures").fill(CAMERA)
    bags.get_by_label("Topic of the poses").fill(ODOMETRY)
    bags.get_by_label("A frame every, metres").fill("2")
    bag.get_by_role("button", name="Enrol again").click()
    expect(bag.get_by_role("status")).to_have_text("3 of 6 frames were taken: 3 created; 3 with poses.")
    assert sent == ["GET", "POST"], "it is not uploaded again"
    places = keyed.places("bagged")
    assert [one["pose"]["x"] for one in places.values()] == [0, 2, 4]
    assert {one["sequence"] for one in places.values()} == {"monday"}
    page.get_by_role("img", name=re.compile("The plan of bagged: 3 places")).wait_for()


@pytest.mark.thorough
def test_what_cannot_be_enrolled_is_told_and_the_rest_is(admin: Operator, keyed: Server, tmp_path: Path) -> None:
    keyed.create_map("mixed")
    folder = recording(tmp_path / "drive", 2)
    (folder / "f1.jpg").write_text("no picture")
    page = admin.go("maps/mixed/enrol")
    page.get_by_label("A folder").set_input_files(folder)
    chosen = page.get_by_role("region", name="To enrol")
    chosen.get_by_role("button", name="Enrol 2 frames").click()
    expect(chosen.get_by_role("status")).to_contain_text("1 new, 0 replaced, 0 were there, 1 refused")
    expect(chosen.get_by_role("list", name="Refused frames")).to_contain_text("f1.jpg is not a picture")
    (folder / "places.csv").write_text("file,x,y,colour\nf0.jpg,1,2,red\n")
    page.get_by_label("A folder").set_input_files(folder)
    page.get_by_text("may name id, x, y, z").first.wait_for()
    (folder / "places.csv").write_text("file,id\nf0.jpg,a\nf1.jpg,a\n")
    page.get_by_label("A folder").set_input_files(folder)
    page.get_by_text("would both have the id a").wait_for()
    expect(page.get_by_role("button", name="Enrol 2 frames")).to_be_disabled()


def with_lasso(page: Page, map_id: str) -> None:
    """Catch all places of a plan."""
    canvas = page.get_by_role("img", name=re.compile(f"Plan of {map_id}"))
    assert eventually(lambda: thickness(page) > 0), "what is not drawn is not caught"
    box = canvas.bounding_box()
    assert box is not None
    canvas.scroll_into_view_if_needed()
    page.get_by_role("button", name="Lasso").click()
    left, top, right, bottom = box["x"] + 2, box["y"] + 2, box["x"] + box["width"] - 2, box["y"] + box["height"] - 2
    page.mouse.move(left, (top + bottom) / 2 + 60)
    page.mouse.down()
    for point in ((left, top + 200), (right, top + 200), (right, bottom - 100), (left, bottom - 100)):
        page.mouse.move(*point, steps=3)
    page.mouse.up()


@pytest.mark.thorough
def test_a_look_is_added_to_a_place_and_removed(visit: Visit, keyed: Server, tmp_path: Path) -> None:
    keyed.create_map("looked")
    keyed.enrol("looked", "p0", world.frame(0), sequence="monday")
    (tmp_path / "dusk.jpg").write_bytes(world.frame_again(0))
    (tmp_path / "none.jpg").write_text("no picture")
    operator = visit("enrol")
    page = operator.go("maps/looked/places/p0")
    panel = page.get_by_role("region", name="Looks")
    panel.get_by_text("None: it is found by the frame").wait_for()
    panel.get_by_label("Pictures of looks").set_input_files(tmp_path / "none.jpg")
    panel.get_by_text("none.jpg is not a picture").wait_for()
    panel.get_by_label("Pictures of looks").set_input_files(tmp_path / "dusk.jpg")
    looks = panel.get_by_role("list", name="Looks").get_by_role("listitem")
    expect(looks).to_have_count(1)
    looks.get_by_role("img", name="A look of p0").wait_for()
    expect(looks).to_contain_text("an operator")
    (stored,) = keyed.client.get("/v1/maps/looked/places/p0/looks").json()["items"]
    operator.go("maps/looked/learning").get_by_text("added by operators").wait_for()
    operator.go("maps/looked/places/p0")
    panel.get_by_role("button", name=f"Remove the look {stored['name']}").click()
    dialog = page.get_by_role("dialog", name="Remove a look of p0")
    dialog.get_by_role("img", name="A look of p0").wait_for()
    assert len(keyed.client.get("/v1/maps/looked/looks").json()["items"]) == 1, "it asks first"
    dialog.get_by_role("button", name="Remove", exact=True).click()
    panel.get_by_text("None: it is found by the frame").wait_for()
    assert keyed.client.get("/v1/maps/looked/looks").json()["items"] == []


@pytest.mark.thorough
@pytest.mark.skipif(not CORRIDOR.is_dir(), reason="needs the data set eval/corridor")
def test_what_a_run_taught_is_shown_and_undone(admin: Operator, keyed: Server) -> None:
    taught(keyed, "hall", "propose")
    drive(keyed, "hall")
    (lesson,) = lessons(keyed, "hall")
    run = lesson["session"]
    proposed = proposals(keyed, "hall")
    page = admin.go("maps/hall/plan")
    with_lasso(page, "hall")
    page.get_by_role("region", name="Within the lasso").get_by_role("button", name="Learning …").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_role("region", name="Proposed").get_by_role("listitem")).to_have_count(len(proposed))
    dialog.get_by_role("button", name=f"Learn {len(proposed)} looks").click()
    dialog.get_by_text("No run proposes a look here.").wait_for()
    expect(dialog.get_by_role("region", name="Looks").get_by_role("listitem")).to_have_count(len(proposed))
    learnt = keyed.client.get("/v1/maps/hall/looks").json()["items"]
    assert [one["run"] for one in learnt] == [run] * len(proposed)
    dialog.get_by_role("button", name="Undo what was learnt here …").click()
    dialog.get_by_text("No later query finds").wait_for()
    dialog.get_by_role("button", name="Cancel").click()
    dialog.get_by_text(f"{len(learnt)} learnt").wait_for()
    admin.go("maps/hall/learning")
    page.get_by_text("Runs propose looks, which wait in the review.").wait_for()
    group = page.get_by_role("region", name=f"The run {run}")
    expect(group).to_contain_text(f"{len(learnt)} looks of {len(learnt)} places, from 60 frames")
    row = page.get_by_role("region", name="Lessons").get_by_role("row").nth(1)
    expect(row.get_by_role("cell").nth(4)).to_have_text(str(lesson["proposals"]))
    assert lesson["calibration"]["outcome"] == "proposed"
    figures = re.compile(r"proposed error 0\.\d+ → 0\.\d+, recall \d\.\d+ → \d\.\d+")
    expect(row.get_by_role("cell").nth(7)).to_contain_text(figures)

    admin.foresee("/looks/")  # their pictures may be on their way while they are removed
    one = learnt[0]  # one by one, by run, or within the lasso
    group.get_by_role("button", name=f"Remove the look {one['name']} of {one['place']}").click()
    dialog.get_by_role("button", name="Remove", exact=True).click()
    expect(group).to_contain_text(f"{len(learnt) - 1} looks")
    group.get_by_role("button", name="Undo this run …").click()
    expect(page.get_by_role("dialog").get_by_role("listitem")).to_have_count(len(learnt) - 1)
    dialog.get_by_role("button", name="Cancel").click()
    admin.go("maps/hall/plan")
    with_lasso(page, "hall")
    page.get_by_role("button", name="Learning …").click()
    dialog.get_by_role("button", name="Undo what was learnt here …").click()
    dialog.get_by_role("button", name="Remove", exact=True).click()
    page.get_by_text(f"{len(learnt) - 1} looks were removed.").wait_for()
    assert keyed.client.get("/v1/maps/hall/looks").json()["items"] == []
    admin.go("maps/hall/learning")
    page.get_by_text("No place has looks").wait_for()
    assert keyed.client.get("/v1/maps/hall/looks").json()["items"] == []
    admin.leave()
    keyed.client.delete("/v1/maps/hall")


@pytest.mark.thorough
def test_a_mask_is_drawn_over_a_frame_by_mouse_and_by_keyboard(visit: Visit, keyed: Server) -> None:
    world.copy(keyed, "masked")
    operator = visit("enrol")
    page = operator.go("maps/masked/cameras")
    page.get_by_text("No cameras").wait_for()
    page.get_by_role("button", name="Add a camera").click()
    form = page.get_by_role("form", name="New camera")
    form.get_by_label("Name").fill("front")
    form.get_by_role("img", name=re.compile("Place .* under the mask")).wait_for()
    drawing = form.get_by_role("img", name=re.compile("^0 areas are ignored"))
    box = drawing.bounding_box()
    assert box is not None
    for x, y in ((0.1, 0.8), (0.9, 0.8), (0.9, 0.95), (0.1, 0.95), (0.1, 0.8)):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    expect(form.get_by_role("status")).to_contain_text("one area, about 12\u00a0% of the frame")
    form.get_by_role("img", name=re.compile("^1 areas are ignored")).focus()
    for keys in (["Space"], ["Shift+ArrowRight", "Space"], ["Shift+ArrowDown", "Space"], ["Enter"]):
        for key in keys:
            page.keyboard.press(key)
    expect(form.get_by_role("status")).to_contain_text("2 areas")
    form.get_by_label("Intrinsics").fill("{")
    form.get_by_role("button", name="Save").click()
    form.get_by_text("The intrinsics cannot be read").wait_for()
    form.get_by_label("Intrinsics").fill('{"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}')
    form.get_by_role("button", name="Save").click()
    card = page.get_by_role("region", name="Camera front")
    expect(card).to_contain_text("2 areas")
    stored = keyed.client.get("/v1/maps/masked/cameras/front").json()
    first, second = stored["mask"]["polygons"]
    assert first == [pytest.approx(one, abs=0.01) for one in ([0.1, 0.8], [0.9, 0.8], [0.9, 0.95], [0.1, 0.95])]
    assert second == [[0.5, 0.5], [0.55, 0.5], [0.55, 0.55]]
    assert stored["intrinsics"]["fx"] == 500

    card.get_by_role("button", name="Edit front").click()
    form = page.get_by_role("form", name="Edit front")
    form.get_by_role("img", name=re.compile("Place .* under the mask")).wait_for()  # the drawing has its size from it
    page.wait_for_function("[...document.querySelectorAll('form img')].every((one) => one.naturalWidth)")
    form.get_by_role("button", name="Remove the last area").click()
    drawing = form.get_by_role("img", name=re.compile("^1 areas are ignored"))
    box = drawing.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.1 * box["width"], box["y"] + 0.8 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 0.7 * box["height"], steps=4)
    page.mouse.up()
    form.get_by_role("button", name="Save").click()
    form.wait_for(state="detached")
    stored = keyed.client.get("/v1/maps/masked/cameras/front").json()
    assert stored["mask"]["polygons"][0][0] == pytest.approx([0.2, 0.7], abs=0.01)
    assert len(stored["mask"]["polygons"]) == 1 and stored["intrinsics"]["fx"] == 500, "intrinsics stay"
    card.get_by_role("button", name="Delete front").click()
    page.get_by_role("dialog").get_by_role("textbox").fill("front")
    page.get_by_role("dialog").get_by_role("button", name="Delete the camera").click()
    page.get_by_text("No cameras").wait_for()


@pytest.mark.thorough
def test_a_map_is_verified_and_made_anew_of_its_images(admin: Operator, keyed: Server) -> None:
    keyed.create_map("kept", keep="image")
    for number in range(3):
        keyed.enrol("kept", f"p{number}", world.frame(number), x=number, y=0, sequence="monday")
    page = admin.go("maps/kept/upkeep")
    verify = page.get_by_role("region", name="Verify")
    verify.get_by_role("button", name="Verify").click()
    verify.get_by_text("succeeded").wait_for()
    expect(verify).to_contain_text(re.compile("ok.*true"))
    expect(page.get_by_role("region", name="Rebuild the index").get_by_role("button")).to_be_disabled()
    keypoints = page.get_by_role("region", name="Keypoints")
    keypoints.get_by_role("button", name="Find keypoints").click()
    keypoints.get_by_text("succeeded").wait_for()
    again = page.get_by_role("region", name="Re-encode")
    again.get_by_label("Id of the new map").fill("kept-2")
    again.get_by_role("button", name="Make the new map").click()
    page.wait_for_url("**/maps/kept-2/plan")
    assert keyed.places("kept-2").keys() == keyed.places("kept").keys()


@pytest.mark.thorough
def test_all_maps_are_exported(admin: Operator, keyed: Server) -> None:
    world.copy(keyed, "another")
    told = keyed.client.get("/v1/maps").json()
    maps = ["another", world.LAB]
    told["items"] = [one for one in told["items"] if one["id"] in maps]  # a browser saves ten in a row, and drops more
    admin.page.route("**/v1/maps?*", lambda route: route.fulfill(json=told))
    page = admin.go("maps")
    saved: list[str] = []
    page.on("download", lambda one: saved.append(one.suggested_filename))
    page.get_by_role("button", name="Export all").click()
    page.get_by_role("dialog", name="Export all maps").get_by_role("button", name="Export all").click()
    page.get_by_text(f"{len(maps)} maps were given to the browser.").wait_for()
    while len(saved) < len(maps):  # the browser tells of each a while later, and in any order
        page.wait_for_timeout(20)
    assert sorted(saved) == sorted(f"{name}.tar" for name in maps)
    admin.leave()
    keyed.client.delete("/v1/maps/another")


def test_a_second_folder_replaces_nothing_by_chance(admin: Operator, keyed: Server, tmp_path: Path) -> None:
    """Cameras count from 000: day and night both have a folder left, with files of the same names."""
    keyed.create_map("clash")
    folders = {name: tmp_path / name / "left" for name in ("day", "night")}
    for first, folder in zip((0, 4), folders.values(), strict=True):
        folder.mkdir(parents=True)
        for number in range(3):
            (folder / f"{number:03d}.jpg").write_bytes(world.frame(first + number))
    page = admin.go("maps/clash/enrol")
    chosen, traverse = page.get_by_role("region", name="To enrol"), page.get_by_label("Traverse")
    status = chosen.locator("p[role=status]", has_text="of 3:")

    def choose(name: str) -> None:
        page.get_by_label("A folder").set_input_files(folders[name])

    def enrolled() -> dict[str, str]:
        return {one: place["sequence"] for one, place in keyed.places("clash").items()}

    choose("day")
    chosen.get_by_role("button", name="Enrol 3 frames").click()
    expect(status).to_have_text("3 of 3: 3 new, 0 replaced, 0 were there.")
    choose("night")  # it is called as its folder, and made unique
    expect(chosen).to_contain_text("The map has a traverse left already; these frames are the traverse left~2.")
    expect(traverse).to_have_value("left~2")
    expect(status).to_have_count(0)
    chosen.get_by_role("button", name="Enrol 3 frames").click()
    expect(status).to_have_text("3 of 3: 3 new, 0 replaced, 0 were there.")
    both = {f"{name}-{number:03d}": name for name in ("left", "left~2") for number in range(3)}
    assert enrolled() == both
    for name, called in (("day", "left"), ("night", "left~2")):  # the very same is gone on with
        keyed.client.delete(f"/v1/maps/clash/places/{called}-002")
        choose(name)
        expect(chosen).to_contain_text("2 of them are there already, with these pictures; the enrolment goes on.")
        expect(traverse).to_have_value(called)
        chosen.get_by_role("button", name="Enrol 3 frames").click()
        expect(status).to_have_text("3 of 3: 1 new, 0 replaced, 2 were there.")
    assert enrolled() == both

    sent: list[str] = []
    page.on("request", lambda one: sent.append(one.url) if one.method == "POST" and ":compare" not in one.url else None)
    traverse.fill("left")  # over the pictures of the day
    traverse.press("Tab")
    clash = chosen.get_by_role("alert")
    expect(clash).to_contain_text("3 of these 3 frames exist already in the traverse left, with other pictures.")
    expect(chosen.get_by_role("button", name="Enrol")).to_have_count(0)
    clash.get_by_role("button", name="Rename to left~3").click()
    expect(traverse).to_have_value("left~3")
    expect(clash).to_have_count(0)
    traverse.fill("left")
    traverse.press("Tab")
    clash.get_by_role("button", name="Cancel").click()
    expect(chosen).to_have_count(0)
    choose("night")
    assert sent == [] and enrolled() == both
    clash.get_by_role("button", name="Replace 3 places").click()
    expect(status).to_have_text("3 of 3: 0 new, 3 replaced, 0 were there.")


@pytest.mark.thorough
def test_over_plain_http_nobody_guesses_whether_an_enrolment_goes_on(
    admin: Operator, keyed: Server, tmp_path: Path
) -> None:
    keyed.create_map("plain")
    folder = recording(tmp_path / "drive", 2)
    page = admin.page
    admin.foresee("Cross-Origin-Opener-Policy")
    admin.root = admin.root.replace("127.0.0.1", "console.test")  # for which a browser has no digests
    admin.go("maps/plain/enrol")
    chosen = page.get_by_role("region", name="To enrol")
    page.get_by_label("A folder").set_input_files(folder)
    chosen.get_by_role("button", name="Enrol 2 frames").click()
    expect(chosen.locator("p[role=status]", has_text="of 2:")).to_contain_text("2 new")
    page.get_by_label("A folder").set_input_files(folder)
    clash = chosen.get_by_role("alert")
    expect(clash).to_contain_text("2 of these 2 frames exist already in the traverse drive; over plain HTTP")
    clash.get_by_role("button", name="Replace 2 places").click()
    expect(chosen.locator("p[role=status]", has_text="of 2:")).to_contain_text("0 new, 0 replaced, 2 were there")


def test_poses_are_seen_with_their_headings_before_they_are_sent(
    admin: Operator, keyed: Server, tmp_path: Path
) -> None:
    keyed.create_map("headed")
    page = admin.go("maps/headed/enrol")
    page.get_by_label("A folder").set_input_files(recording(tmp_path / "drive", 3))
    chosen = page.get_by_role("region", name="To enrol")
    chosen.get_by_role("img", name=re.compile("The poses of these frames: 3")).wait_for()
    expect(page.get_by_role("region", name="Frames", exact=True)).to_contain_text("counter-clockwise from +x")
    admin.go(f"maps/{world.LAB}/places/monday-00").get_by_role("button", name="Edit").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("heading").fill("90")
    dialog.get_by_role("img", name="Points 0 degrees clockwise from +y").wait_for()
    dialog.get_by_label("Pose").select_option("geographic")
    dialog.get_by_role("img", name="Points 90 degrees clockwise from north").wait_for()


@pytest.mark.thorough
def test_a_bag_of_other_pictures_replaces_nothing_by_chance(admin: Operator, keyed: Server, tmp_path: Path) -> None:
    keyed.create_map("bags")
    page = admin.go("maps/bags/enrol")
    bag = page.get_by_role("region", name="walk.mcap")

    def choose(first: int) -> None:
        file = tmp_path / str(first) / "walk.mcap"
        file.parent.mkdir()
        write_mcap(file, [compressed(START + n * 10**9, world.frame(first + n)) for n in range(2)])
        page.get_by_label("Pictures, a video or bags").set_input_files(file)

    choose(0)
    bag.get_by_role("button", name="Upload and enrol").click()
    expect(bag.get_by_role("status")).to_contain_text("2 of 2 frames were taken: 2 created")
    choose(4)
    bag.get_by_role("button", name="Upload and enrol").click()
    expect(bag.get_by_role("alert")).to_contain_text("2 of 2 frames exist already in the traverse 'walk', with other")
    bag.get_by_role("button", name="Rename to walk~2").click()
    expect(bag.get_by_role("status")).to_contain_text("2 of 2 frames were taken: 2 created")
    assert sorted(one["sequence"] for one in keyed.places("bags").values()) == ["walk", "walk", "walk~2", "walk~2"]
