"""Calibration, traverses and health in the console, and what the map then is."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import expect

from tests.service.console import world
from tests.service.console.conftest import OUT_OF_PANEL, Operator, Visit
from tests.service.map_jobs import wait_until
from tests.service.server import Server


@pytest.fixture(scope="module")
def yard(keyed: Server) -> Iterator[str]:
    """Another map of the drawn world, which these tests calibrate and align."""
    world.copy(keyed, "yard")
    keyed.client.patch("/v1/maps/yard", json={"verification": False}).raise_for_status()  # thresholds alone decide
    yield "yard"
    keyed.client.delete("/v1/maps/yard")


@pytest.mark.thorough
def test_a_map_is_calibrated_as_a_dry_run_and_then_for_good(admin: Operator, keyed: Server, yard: str) -> None:
    page = admin.go(f"maps/{yard}/calibration")
    page.get_by_text("Nothing was measured yet").wait_for()

    def calibrate(action: str) -> None:
        page.get_by_role("button", name="Calibrate", exact=True).click()
        dialog = page.get_by_role("dialog")
        dialog.get_by_label("Ask").select_option("sequence")
        dialog.get_by_role("combobox", name="Traverse", exact=True).select_option("tuesday")
        dialog.get_by_label("Share").fill("0.8")
        if action == "Calibrate":
            dialog.get_by_label("Dry run").uncheck()
        dialog.get_by_role("button", name=action, exact=True).click()
        dialog.wait_for(state="detached")

    calibrate("Try it")
    page.get_by_role("img", name=re.compile("Reliability diagram")).wait_for()
    page.get_by_text("not stored", exact=False).first.wait_for()
    assert keyed.client.get(f"/v1/maps/{yard}").json()["calibration"]["source"] == "encoder-default"
    calibrate("Calibrate")
    page.get_by_text("sequence:tuesday").wait_for()
    listed = admin.go("maps").get_by_role("row").filter(has=page.get_by_role("link", name=yard, exact=True))
    listed.get_by_text("calibrated", exact=True).wait_for()  # which does not make it good
    admin.go(f"maps/{yard}/calibration")
    assert keyed.client.get(f"/v1/maps/{yard}").json()["calibration"]["source"] == "sequence:tuesday"

    page.get_by_role("button", name="Calibrate", exact=True).click()  # which now replaces one of the map's own
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Dry run").uncheck()
    replace = dialog.get_by_role("button", name="Calibrate", exact=True)
    expect(replace).to_be_disabled()
    dialog.get_by_label("to replace the calibration").fill(yard)
    expect(replace).to_be_enabled()
    dialog.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Back to the encoder's").click()
    dialog.get_by_label("to confirm").fill(yard)
    dialog.get_by_role("button", name="Give up its own").click()
    page.get_by_text("encoder-default").wait_for()
    assert keyed.client.get(f"/v1/maps/{yard}").json()["calibration"]["source"] == "encoder-default"


@pytest.mark.thorough
def test_a_dry_run_says_what_it_would_store_and_is_stored_by_a_button(admin: Operator, keyed: Server) -> None:
    world.copy(keyed, "dry")
    path = "/v1/maps/dry"
    order = {"method": "sequence", "sequence": "tuesday", "target": {"rule": "precision", "value": 0.8}}
    assert keyed.client.post(f"{path}/calibrate", json=order | {"dry_run": True}).status_code == 200
    page = admin.go("maps/dry/calibration")
    table = page.get_by_role("table", name="Effect of the change")
    row = table.get_by_role("row", name=re.compile("^unknown"))
    first = keyed.client.get(f"{path}/calibration").json()
    expect(row.get_by_role("cell").nth(1)).to_have_text(str(first["now"]["verdicts"]["unknown"]))

    page.get_by_role("button", name="Calibrate", exact=True).click()  # another dry run, which leaves the map's ETag
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Ask").select_option("map")
    dialog.get_by_label("Share").fill("0.5")
    dialog.get_by_role("button", name="Try it").click()
    page.get_by_text("The dry run is done.").wait_for()
    state = keyed.client.get(f"{path}/calibration").json()
    now, proposed = (state[name]["verdicts"]["recognized"] for name in ("now", "proposed"))
    found = state["measured"]["report"]["calibration"]
    unknown = state["now"]["verdicts"]["unknown"]
    assert unknown != first["now"]["verdicts"]["unknown"] and state["revision"] == first["revision"]
    expect(row.get_by_role("cell").nth(1)).to_have_text(str(unknown))
    told = page.get_by_role("region", name="Dry run")
    written = f"{state['calibration']['threshold']:.3f} → {found['threshold']:.3f}".replace("-", "−")
    expect(told).to_contain_text(written)
    expect(told).to_contain_text(f"recognized {now} → {proposed} of the")
    assert keyed.client.get(path).json()["calibration"]["source"] == "encoder-default"

    told.get_by_role("button", name="Store it").click()
    dialog.get_by_role("button", name="Store the calibration").click()
    told.wait_for(state="detached")
    assert keyed.client.get(path).json()["calibration"] == found
    page.get_by_role("status").get_by_role("button", name="Undo").click()
    page.get_by_text("encoder-default").wait_for()
    assert keyed.client.get(path).json()["calibration"]["source"] == "encoder-default"


@pytest.mark.thorough
def test_a_threshold_says_what_it_would_change_and_is_applied_and_undone(
    admin: Operator, keyed: Server, yard: str
) -> None:
    order = {"method": "sequence", "sequence": "tuesday", "target": {"rule": "precision", "value": 0.8}}
    assert keyed.client.post(f"/v1/maps/{yard}/calibrate", json=order).status_code == 200
    before = keyed.client.get(f"/v1/maps/{yard}").json()["calibration"]
    page = admin.go(f"maps/{yard}/calibration")
    page.set_viewport_size({"width": 390, "height": 844})
    page.get_by_role("table", name="Effect of the change").wait_for()
    assert page.evaluate(OUT_OF_PANEL) == []
    slider = page.get_by_role("slider", name=re.compile("Threshold"))
    slider.focus()
    page.keyboard.press("End")
    table = page.get_by_role("table", name="Effect of the change")
    table.get_by_role("row", name=re.compile("^recognized")).get_by_text("−").wait_for()
    assert keyed.client.get(f"/v1/maps/{yard}").json()["calibration"] == before, "nothing is changed by looking"
    page.get_by_role("button", name="Apply").click()
    page.get_by_text("manual").wait_for()
    applied = keyed.client.get(f"/v1/maps/{yard}").json()["calibration"]
    assert applied["threshold"] > before["threshold"] and applied["source"] == "manual"
    with page.expect_response(lambda answer: answer.request.method == "PATCH") as undone:
        page.get_by_role("button", name="Undo").click()
    assert undone.value.ok
    page.get_by_role("status").get_by_role("button", name="Undo").wait_for(state="detached")
    admin.settle()
    after = keyed.client.get(f"/v1/maps/{yard}").json()["calibration"]
    assert after == before, "its source, its curve and what it rests on are back as well"


@pytest.mark.thorough
def test_a_threshold_is_not_applied_over_somebody_elses(admin: Operator, keyed: Server, yard: str) -> None:
    order = {
        "method": "sequence",
        "sequence": "tuesday",
        "target": {"rule": "precision", "value": 0.8},
        "dry_run": True,
    }
    assert keyed.client.post(f"/v1/maps/{yard}/calibrate", json=order).status_code == 200
    page = admin.go(f"maps/{yard}/calibration")
    keyed.client.patch(f"/v1/maps/{yard}", json={"description": "changed meanwhile"})
    page.get_by_role("slider", name=re.compile("Threshold")).focus()
    page.keyboard.press("Home")
    admin.foresee("412")
    page.get_by_role("button", name="Apply").click()
    told = page.get_by_role("region", name="Threshold").get_by_role("alert")
    told.get_by_role("button", name="Try again").click()
    told.wait_for(state="detached")


@pytest.mark.thorough
def test_two_traverses_are_compared_and_aligned(visit: Visit, keyed: Server, yard: str) -> None:
    operator = visit("enrol")
    page = operator.go(f"maps/{yard}/traverses")
    page.get_by_text("12 of 12 within 3 frames").wait_for()
    page.get_by_text("not aligned").wait_for()
    matrix = page.get_by_role("img", name=re.compile("Similarity of 12 frames"))
    box = matrix.bounding_box()
    assert box is not None
    cell = box["width"] / 12
    matrix.click(position={"x": 9.5 * cell, "y": 2.5 * cell})
    page.get_by_text("frame 3 of tuesday against 10 of monday: 0.").wait_for()
    pair = page.get_by_role("region", name="Pair")
    pair.get_by_role("link", name="tuesday-02").wait_for()
    pair.get_by_role("link", name="monday-09").wait_for()
    matrix.focus()
    page.keyboard.press("ArrowDown")
    pair.get_by_role("link", name="tuesday-03").wait_for()
    page.get_by_role("button", name="Preview alignment").click()
    page.get_by_text("no, a dry run").wait_for()
    aligned = f"/v1/maps/{yard}/similarity?query=tuesday&reference=monday"
    page.get_by_role("button", name="Align …", exact=True).click()
    assert not keyed.client.get(aligned).json()["aligned"], "it asks first"
    page.get_by_role("dialog").get_by_role("button", name="Align").click()
    page.get_by_text("aligned", exact=True).wait_for()
    page.get_by_label("as aligned").check()
    assert keyed.client.get(aligned).json()["aligned"]
    page.get_by_role("button", name="Undo the alignment …").click()
    page.get_by_role("dialog").get_by_role("button", name="Undo the alignment").click()
    page.get_by_text("not aligned").wait_for()
    assert not keyed.client.get(aligned).json()["aligned"]


@pytest.mark.thorough
def test_an_alignment_does_not_prove_itself(admin: Operator, keyed: Server) -> None:
    keyed.create_map("handed")
    for number in range(world.PLACES):
        for name, data, pose in (
            ("monday", world.frame(number), world.pose_of(number)),
            ("tuesday", world.frame_again(number), {}),
        ):
            keyed.enrol("handed", f"{name}-{number:02d}", data, sequence=name, **pose)
    page = admin.go("maps/handed/traverses")
    page.get_by_text("none: their frames have no poses of their own").wait_for()
    page.get_by_role("button", name="Align …", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Align").click()
    page.get_by_text("tuesday was aligned.").wait_for()
    place = "/v1/maps/handed/places/tuesday-03"
    assert keyed.client.get(place).json()["pose_of"] == "monday-03"
    page.get_by_text("aligned", exact=True).wait_for()
    admin.settle()
    page.get_by_text("none: their frames have no poses of their own").wait_for()
    expect(page.get_by_text("within 3 frames")).to_have_count(0)
    page.get_by_role("status").get_by_role("button", name="Undo").click()
    page.get_by_text("not aligned").wait_for()
    assert keyed.client.get(place).json()["pose_of"] is None


def test_a_traverse_is_deleted_by_its_name(admin: Operator, keyed: Server) -> None:
    keyed.create_map("short")
    for number in range(2):
        keyed.enrol("short", f"s{number}", world.frame(number), sequence=f"walk-{number}")
    page = admin.go("maps/short/traverses")
    expect(page.locator(".picture.waiting")).to_have_count(0)
    page.get_by_role("button", name="Delete walk-0").click()
    page.get_by_role("dialog").get_by_role("textbox").fill("walk-0")
    page.get_by_role("button", name="Delete the traverse").click()
    page.get_by_role("link", name="walk-0").wait_for(state="detached")
    assert keyed.places("short").keys() == {"s1"}


@pytest.mark.thorough
def test_health_is_examined_and_a_map_pruned(admin: Operator, keyed: Server) -> None:
    world.copy(keyed, "pruned")
    for number in range(6):  # a third view of a place, without which the other two do as well
        pose = world.pose_of(number, 0.2)
        keyed.enrol("pruned", f"wednesday-{number:02d}", world.frame(number), **pose, sequence="wednesday")
    enrolled = len(keyed.places("pruned"))
    page = admin.go("maps/pruned/health")
    page.get_by_text("The map has not been queried yet.").wait_for()
    prune = page.get_by_role("region", name="Prune")
    prune.get_by_role("slider").fill("10")
    prune.get_by_role("button", name="Preview the loss").click()
    prune.get_by_text("Recall after").wait_for()
    assert len(keyed.places("pruned")) == enrolled, "a dry run removes nothing"
    prune.get_by_role("button", name=re.compile(r"Delete \d+ places")).click()
    page.get_by_role("dialog").get_by_role("textbox").fill("pruned")
    page.get_by_role("dialog").get_by_role("button", name="Delete the places").click()
    prune.get_by_text("Gone").wait_for()
    assert len(keyed.places("pruned")) < enrolled


@pytest.mark.thorough
def test_health_advises_to_align_a_second_drive_and_counts_what_it_leaves_out(admin: Operator, keyed: Server) -> None:
    keyed.create_map("street")
    for number in range(world.PLACES):
        for name, data in (("monday", world.frame(number)), ("tuesday", world.frame_again(number))):
            keyed.enrol("street", f"{name}-{number:02d}", data, sequence=name)
    keyed.query("street", world.frame_again(0))
    page = admin.go("maps/street/health")
    told = page.get_by_role("region", name="One route")
    expect(told).to_contain_text("tuesday and monday seem to be one route")
    page.get_by_text("That says nothing yet: after 1 query, of 72 that it takes.").wait_for()
    for _ in range(71):
        keyed.query("street", world.frame_again(0))
    page.get_by_role("button", name="Examine again").click()
    silent = page.locator("section").filter(has=page.get_by_role("heading", name="Never matched"))
    count = keyed.client.get("/v1/maps/street/health").json()["never_matched"]["count"]
    assert count > 20  # more than the report lists
    silent.get_by_text(f"and {count - 8} more").wait_for()
    told.get_by_role("link", name="Compare and align them").click()
    page.wait_for_url("**/traverses?query=tuesday&reference=monday")


@pytest.mark.thorough
def test_another_map_is_merged_after_a_dry_run(admin: Operator, keyed: Server) -> None:
    for name, numbers in (("target", (0, 1)), ("source", (2, 3))):
        keyed.create_map(name)
        for number in numbers:
            keyed.enrol(name, f"{name}-{number}", world.frame(number), sequence=name)
    page = admin.go("maps/target/health")
    merge = page.get_by_role("region", name="Merge")
    merge.get_by_label("From").select_option("source")
    merge.get_by_role("button", name="Preview the merge").click()
    expect(merge.get_by_role("status")).to_have_text("None of 2 places of source is there already; 2 would come.")
    merge.get_by_role("button", name="Copy 2 places").click()
    page.get_by_role("dialog").get_by_role("textbox").fill("target")
    page.get_by_role("dialog").get_by_role("button", name="Copy the places").click()
    merge.get_by_text("2 places of source came; 0 were there already.").wait_for()
    assert keyed.places("target").keys() == {"target-0", "target-1", "source-2", "source-3"}


@pytest.mark.thorough
def test_maps_whose_poses_lie_in_no_common_frame_are_not_merged(admin: Operator, keyed: Server) -> None:
    for name, pose in (("metric", {"x": 1, "y": 2}), ("geographic", {"latitude": 48.1, "longitude": 11.5})):
        keyed.create_map(name)
        assert keyed.enrol(name, f"{name}-0", world.frame(len(name)), sequence=name, **pose).status_code == 201
    page = admin.go("maps/metric/health")
    merge = page.get_by_role("region", name="Merge")
    merge.get_by_label("From").select_option("geographic")
    merge.get_by_role("button", name="Preview the merge").click()
    merge.get_by_text("The map 'geographic' has geographic coordinates").wait_for()
    expect(merge.get_by_role("button", name=re.compile("^Copy"))).to_have_count(0)


@pytest.mark.thorough
def test_backups_are_scheduled_made_and_missed(admin: Operator, keyed: Server) -> None:
    page = admin.go("backups")
    page.get_by_role("button", name="Change the schedule").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("All maps are saved").select_option("only by request")
    dialog.get_by_label("Kept").fill("0")
    dialog.get_by_role("button", name="Save").click()
    expect(dialog.get_by_label("Kept")).to_be_focused()  # by the browser, which says what is wrong
    dialog.get_by_label("Kept").fill("2")
    dialog.get_by_role("button", name="Save").click()
    schedule = page.get_by_role("region", name="Schedule")
    expect(schedule).to_contain_text(re.compile("only by request.*the latest 2"))
    wait_until(lambda: keyed.client.get("/v1/backups").json()["running"] is None)  # the first one, of the start
    admin.go("home")
    admin.go("backups")
    page.get_by_role("button", name="Back up now").click()
    schedule.get_by_text("succeeded").wait_for()
    made = keyed.client.get("/v1/backups").json()["items"]
    table = page.get_by_role("region", name="Backups")
    expect(table.get_by_role("row").nth(1)).to_contain_text(made[0]["id"])
    expect(table.get_by_role("row").nth(1)).to_contain_text(f"{made[0]['maps']}")

    told = keyed.client.get("/v1/backups").json() | {"problem": "1 of 4 maps could not be saved. hall: it is damaged"}
    page.route("**/v1/backups", lambda route: route.fulfill(json=told))
    alarms = admin.go("home").get_by_role("region", name="Alarms")
    expect(alarms).to_contain_text("The latest backup failed 1 of 4 maps could not be saved.")
    alarms.get_by_role("link", name="The latest backup failed").click()
    page.get_by_role("region", name="The latest backup failed").get_by_text("hall: it is damaged").wait_for()
    told |= {"problem": None, "next_at": "2026-11-20T10:00:00Z"}
    admin.go("home")
    expect(alarms).to_contain_text("A backup is overdue")
