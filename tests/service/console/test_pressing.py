"""What is pressed at once, as phones and quick hands do: it means what the view shows, and nothing of inputs before."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import pytest
from playwright.sync_api import Locator, Page, Route, expect

from tests.service.console import world
from tests.service.console.conftest import Operator
from tests.service.console.world import LAB
from tests.service.server import Server

AT_ONCE = """async ([fields, button]) => {
  const turn = async () => { for (let one = 0; one < 5; one += 1) await Promise.resolve(); };
  for (const [field, value] of fields) {
    if (field.type === "checkbox") field.click();
    else {
      const kind = field.constructor;
      Object.getOwnPropertyDescriptor(kind.prototype, "value").set.call(field, value);
      for (const name of ["input", "change"]) {
        field.dispatchEvent(new Event(name, { bubbles: true }));
        await turn();
      }
    }
    await turn();
  }
  const there = button.isConnected && !button.disabled;
  if (there) button.click(); // what is gone from the page cannot be pressed
  return there;
}"""
"""Fills in fields and presses a button in the same task: what is drawn anew is there, and no effect has taken place."""


def press_at_once(page: Page, fields: Mapping[str, str | None], button: Locator, within: Locator | None = None) -> bool:
    """Fill in fields by their labels, press, and return whether the button could be pressed."""
    place = within or page
    handles = [[place.get_by_label(label).first.element_handle(), value] for label, value in fields.items()]
    return bool(page.evaluate(AT_ONCE, [handles, button.element_handle()]))


@dataclass(frozen=True)
class Form:
    """A form, what is filled in, and the request that it then means.

    opened: buttons that are pressed before.
    sent: fields of the request's body, or of its query.
    """

    view: str
    fields: Mapping[str, str | None]
    button: str
    method: str
    path: str
    sent: Mapping[str, Any]
    opened: tuple[str, ...] = field(default=())


FORMS = {
    "create a map": Form(
        "maps", {"Id": "made", "Precision": "compressed"}, "Create", "POST", "/v1/maps",
        {"id": "made", "precision": "compressed"}, ("Create a map",),
    ),
    "create a key": Form(
        "keys", {"Name": "robot-1", "Role": "enrol"}, "Create", "POST", "/v1/keys",
        {"name": "robot-1", "role": "enrol"}, ("Create a key",),
    ),
    "rotate a key": Form(
        "keys", {"The old one ends": "1"}, "Make the new key", "POST", "/v1/keys",
        {"name": "stranger-key", "maps": ["elsewhere"]}, ("Rotate stranger-key",),
    ),
    "backups": Form(
        "backups", {"Kept": "7"}, "Save", "PUT", "/v1/backups/schedule", {"keep": 7}, ("Change the schedule",)
    ),
    "calibrate": Form(
        f"maps/{LAB}/calibration", {"Ask": "labels"}, "Try it", "POST", f"/v1/maps/{LAB}/calibrate",
        {"method": "labels", "dry_run": True}, ("Calibrate",),
    ),
    "prune": Form(
        f"maps/{LAB}/health", {"Recall that may be lost": "4"}, "Preview the loss", "POST", f"/v1/maps/{LAB}/prune",
        {"max_recall_loss": 0.04, "dry_run": True},
    ),
    "merge": Form(
        f"maps/{LAB}/health", {"From": "pressed", "Where names conflict": "skip"}, "Preview the merge", "POST",
        f"/v1/maps/{LAB}/merge", {"from": "pressed", "on_conflict": "skip", "dry_run": True},
    ),
    "align": Form(
        f"maps/{LAB}/traverses", {"Frames of": "monday", "against": "tuesday"}, "Preview alignment", "POST",
        f"/v1/maps/{LAB}/align", {"sequence": "monday", "with": ["tuesday"]},
    ),
    "delete places": Form(
        f"maps/{LAB}/places?sequence=monday", {"Traverse": "tuesday"}, "Delete all of these", "POST",
        f"/v1/maps/{LAB}/places:delete", {"filter": {"sequence": "tuesday"}, "dry_run": True},
    ),
    "edit a place": Form(
        f"maps/{LAB}/places/monday-00", {"x": "3", "Traverse": "dusk"}, "Save", "PATCH",
        f"/v1/maps/{LAB}/places/monday-00", {"sequence": "dusk"}, ("Edit",),
    ),
    "camera": Form(
        f"maps/{LAB}/cameras", {"Name": "rear"}, "Save", "PUT", f"/v1/maps/{LAB}/cameras/rear", {"mask": None},
        ("Add a camera",),
    ),
    "re-encode": Form(
        "maps/pressed/upkeep", {"Id of the new map": "anew"}, "Make the new map", "POST", "/v1/maps/pressed/re-encode",
        {"to": "anew"},
    ),
    "stored frames": Form(
        f"maps/{LAB}/review", {"unknown": None, "At most, frames": "9"}, "Save", "PATCH", f"/v1/maps/{LAB}",
        {"review": {"verdicts": ["unknown"], "most_frames": 9, "most_bytes": 2**28}}, ("Stored frames",),
    ),
    "audit": Form("audit", {"Map": LAB}, "Save as CSV", "GET", "/v1/audit", {"map": LAB, "limit": "1000"}),
    "key": Form("maps", {"Key": "placerec_no"}, "Use the key", "GET", "/v1/key", {}, ("Change key",)),
}  # fmt: skip


@pytest.fixture(scope="module")
def pressed(keyed: Server) -> str:
    """A map that keeps its images, with places of the other one and of its own."""
    keyed.create_map("pressed", keep="image")
    keyed.enrol("pressed", "p0", world.frame(0), sequence="monday")
    return "pressed"


@pytest.mark.parametrize("form", [pytest.param(form, id=name) for name, form in FORMS.items()])
def test_a_form_sends_what_it_shows(admin: Operator, pressed: str, form: Form) -> None:
    admin.foresee("409")
    page = admin.go(form.view)
    for name in form.opened:
        page.get_by_role("button", name=name, exact=True).click()
    seen: list[dict[str, Any]] = []

    def answer(route: Route) -> None:
        request = route.request
        if request.method != form.method or urlsplit(request.url).path != form.path:
            return route.fallback()
        body = request.post_data
        seen.append(json.loads(body) if body else dict(parse_qsl(urlsplit(request.url).query)))
        problem = {"type": "urn:placerec:problem:none", "title": "It is only looked at", "status": 409}
        return route.fulfill(status=409, json=problem, content_type="application/problem+json")

    page.route("**/v1/**", answer)
    dialog = page.get_by_role("dialog")
    within = dialog if dialog.count() else page.locator("main")
    button = within.get_by_role("button", name=form.button, exact=True)
    assert press_at_once(page, form.fields, button, within)
    page.get_by_text("It is only looked at").first.wait_for()
    matching = [one for one in seen if {name: one.get(name) for name in form.sent} == form.sent]
    assert matching and (form.method == "GET" or len(seen) == 1), seen


def traverse(folder: Path, *numbers: int) -> Path:
    folder.mkdir(parents=True)
    for place, number in enumerate(numbers):
        (folder / f"{place:03d}.jpg").write_bytes(world.frame(number))
    return folder


def test_a_traverse_that_was_typed_is_the_one_that_is_stored(admin: Operator, keyed: Server, tmp_path: Path) -> None:
    keyed.create_map("typed")
    keyed.enrol("typed", "day-000", world.frame(5), sequence="day")
    page = admin.go("maps/typed/enrol")
    page.get_by_label("A folder").set_input_files(traverse(tmp_path / "left", 0, 1))
    chosen = page.get_by_role("region", name="To enrol")
    expect(chosen).to_contain_text("left-000 to left-001")
    button = chosen.get_by_role("button", name="Enrol 2 frames")
    press_at_once(page, {"Traverse": "night"}, button)
    expect(chosen.get_by_role("status").last).to_have_text("2 of 2: 2 new, 0 replaced, 0 were there.")
    stored = {one: place["sequence"] for one, place in keyed.places("typed").items()}
    assert stored == {"day-000": "day", "night-000": "night", "night-001": "night"}
    # One that would replace places is not begun, however quickly it is pressed.
    press_at_once(page, {"Traverse": "day"}, button)
    expect(chosen.get_by_role("alert")).to_contain_text("1 of these 2 frames exist already in the traverse day")
    expect(chosen.get_by_role("status")).to_have_count(0)  # what was sent of others is not shown
    assert keyed.places("typed").keys() == stored.keys()


def test_chosen_places_are_those_that_are_shown(admin: Operator) -> None:
    page = admin.go(f"maps/{LAB}/places?sequence=monday")
    page.get_by_label("Choose monday-03").check()
    delete = page.get_by_role("button", name="Delete 1 chosen")
    assert not press_at_once(page, {"Traverse": "tuesday"}, delete), "it is of places that are not shown any more"
    page.get_by_text("tuesday-00").first.wait_for()
    expect(page.get_by_role("dialog")).to_have_count(0)


@pytest.mark.parametrize(
    ("view", "read", "button"),
    [
        pytest.param("keys", "**/v1/keys?*", "Create a key", id="whether it is the first key"),
        pytest.param(f"maps/{LAB}/calibration", "**/calibration", "Calibrate", id="whether it replaces a calibration"),
    ],
)
def test_nothing_is_opened_before_it_is_known(admin: Operator, view: str, read: str, button: str) -> None:
    held: list[Route] = []
    admin.page.route(read, lambda route: held.append(route))
    admin.page.goto(f"{admin.root}/console#/{view}")
    shown = admin.page.get_by_role("button", name=button, exact=True)
    expect(shown).to_be_disabled()
    admin.page.wait_for_function("() => document.querySelector('main .loading') !== null")
    for route in held:
        route.continue_()
    expect(shown).to_be_enabled()


def test_a_report_goes_with_what_it_is_of(admin: Operator, keyed: Server, pressed: str) -> None:
    page = admin.go(f"maps/{LAB}/health")
    merge = page.get_by_role("region", name="Merge")
    merge.get_by_label("From").select_option(pressed)
    merge.get_by_label("Where names conflict").select_option("rename")
    merge.get_by_role("button", name="Preview the merge").click()
    report = merge.get_by_role("status")
    expect(report).to_have_text("None of 1 place of pressed is there already; 1 would come.")
    copy = merge.get_by_role("button", name="Copy 1 place")
    assert not press_at_once(page, {"Where names conflict": "skip"}, copy, merge), "it is of another order"
    expect(report).to_have_count(0)
    expect(page.get_by_role("dialog")).to_have_count(0)
