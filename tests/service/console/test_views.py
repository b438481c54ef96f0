"""Every view for every role, in light and dark, at three sizes; axe finds nothing."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, Route, expect

from tests.service.console.conftest import OUT_OF_PANEL, SIZES, Operator, Visit
from tests.service.console.world import LAB
from tests.service.server import Server
from tests.service.wire import eventually

OF_MAP = {
    "plan": (LAB, "query"),
    "places": ("Places", "query"),
    "places/monday-03": ("monday-03", "query"),
    "enrol": ("Enrol", "enrol"),
    "try": ("Try", "query"),
    "live": ("Live", "query"),
    "answers": ("Answers", "query"),
    "traverses": ("Traverses", "query"),
    "calibration": ("Calibration", "query"),
    "review": ("Review", "enrol"),
    "learning": ("Learning", "query"),
    "health": ("Health", "enrol"),
    "cameras": ("Cameras", "query"),
    "upkeep": ("Upkeep", "admin"),
}
OF_SERVICE = {
    "home": ("Home", "query"),
    "robots": ("Robots", "query"),
    "maps": ("Maps", "query"),
    "jobs": ("Jobs", "query"),
    "backups": ("Backups", "admin"),
    "keys": ("Keys", "admin"),
    "audit": ("Audit", "admin"),
    "service": ("Service", "query"),
}
VIEWS = {f"maps/{LAB}/{name}": told for name, told in OF_MAP.items()} | OF_SERVICE
TOO_WIDE = """[...document.querySelectorAll("body *")]
  .filter((one) => one.getBoundingClientRect().right > innerWidth && !one.closest(".table"))
  .map((one) => `${one.tagName}.${one.className} ${one.textContent.slice(0, 40)}`)"""
LEVELS = ("query", "enrol", "admin")


def open_to(role: str, needed: str) -> bool:
    return LEVELS.index(role) >= LEVELS.index(needed)


@pytest.mark.thorough
@pytest.mark.parametrize("role", LEVELS[:2])
def test_a_role_sees_what_it_may_do_and_nothing_else(visit: Visit, role: str) -> None:
    operator = visit(role)
    changes = "Create|Delete|Edit|Import|Export|Calibrate|Apply"
    refused = (
        rf"^\s*({changes}|Align|Preview alignment)"
        if role == "query"
        else r"^\s*(Create|Import|Export\s*$|Calibrate|Apply)"
    )
    for view, (title, needed) in VIEWS.items():
        page = operator.go(view)
        expect(page.get_by_role("heading", level=1)).to_have_text(
            title if open_to(role, needed) else "Not for this key"
        )
        expect(page.locator("main").get_by_role("button").filter(has_text=re.compile(refused))).to_have_count(0)
        if role == "query":
            expect(page.locator("main .danger")).to_have_count(0)
    expect(page.locator(".identity")).to_contain_text(re.compile(f"^{role}-key"))
    links = page.get_by_role("navigation", name="Views").get_by_role("link")
    expect(links.filter(has_text="Keys")).to_have_count(0)
    expect(links.filter(has_text="Health")).to_have_count(1 if role == "enrol" else 0)


SOME = (f"maps/{LAB}/plan", f"maps/{LAB}/calibration", "service")
"""Views with a drawing, a diagram, and tables."""
OF_MAP_REST, OF_SERVICE_REST = (
    [view for view in VIEWS if view not in SOME and view.startswith(f"maps/{LAB}/") == of_map]
    for of_map in (True, False)
)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "views",
    [
        pytest.param(SOME, id="some"),
        pytest.param(OF_MAP_REST, id="map", marks=pytest.mark.thorough),
        pytest.param(OF_SERVICE_REST, id="service", marks=pytest.mark.thorough),
    ],
)
def test_an_admin_sees_every_view_in_light_and_dark_on_any_screen(visit: Visit, views: Sequence[str]) -> None:
    operator = visit("admin")
    for view in views:
        title, _ = VIEWS[view]
        page = operator.go(view)
        expect(page.get_by_role("heading", level=1)).to_have_text(title)
        check_with_axe(operator, view)
        page.emulate_media(color_scheme="dark")
        check_with_axe(operator, f"{view}, dark", only=COLOURS)
        page.emulate_media(color_scheme="light")
        for size, (width, height) in SIZES.items():
            page.set_viewport_size({"width": width, "height": height})
            check_width(page, f"{view}, {size}")
        page.set_viewport_size({"width": SIZES["laptop"][0], "height": SIZES["laptop"][1]})
    expect(page.get_by_role("navigation", name="Views").get_by_role("link", name="Keys")).to_have_count(1)
    expect(page.locator(".identity")).to_contain_text(re.compile("^admin-key"))


def check_width(page: Page, where: str) -> None:
    """Fail if the page, or a part of a panel, does not become as narrow as it has to."""
    fits = "document.documentElement.scrollWidth <= innerWidth"
    done = eventually(lambda: page.evaluate(fits) and page.evaluate(OUT_OF_PANEL) == [], seconds=10)
    assert done, (where, page.evaluate(TOO_WIDE), page.evaluate(OUT_OF_PANEL))


COLOURS = ["color-contrast", "link-in-text-block"]
"""The rules that another theme can break."""


def check_with_axe(operator: Operator, where: str, only: list[str] | None = None) -> None:
    """Fail for what axe finds, with a rule that is not among its own, or for ``only`` these rules."""
    rules = {"rules": {"label-content-name-mismatch": {"enabled": True}}}
    options = {"resultTypes": ["violations"]} | ({"runOnly": only} if only else rules)
    found = [
        (one["id"], one["nodes"][0]["html"][:200], one["nodes"][0].get("failureSummary", "")[:300])
        for one in Axe().run(operator.page, options=options).response["violations"]
    ]
    assert found == [], where


@pytest.mark.thorough
@pytest.mark.parametrize("size", ["phone", "wall"])
def test_a_view_that_begins_on_this_screen_is_not_wider(visit: Visit, size: str) -> None:
    operator = visit("admin", size=size)
    for view in (
        f"maps/{LAB}/plan",
        f"maps/{LAB}/traverses",
        f"maps/{LAB}/calibration",
    ):  # these draw as wide as they are
        page = operator.go(view)
        check_width(page, view)


def test_on_a_phone_the_views_are_behind_a_button(visit: Visit) -> None:
    operator = visit("admin", size="phone")
    page = operator.go("maps")
    page.get_by_role("link", name="Jobs").wait_for(state="hidden")
    page.get_by_role("button", name="Menu").click()
    page.get_by_role("link", name="Jobs").click()
    page.get_by_role("heading", name="Jobs").wait_for()
    page.get_by_role("link", name="Audit").wait_for(state="hidden")


def test_light_and_dark_follow_the_system_until_one_is_chosen(visit: Visit) -> None:
    operator = visit("admin", theme="dark")
    page = operator.go("maps")
    ground = "getComputedStyle(document.documentElement).backgroundColor"
    dark = page.evaluate(ground)
    page.get_by_text("light", exact=True).click()
    light = page.evaluate(ground)
    assert dark != light
    page.reload()
    operator.settle()
    assert eventually(lambda: page.evaluate(ground) == light)
    page.get_by_text("auto", exact=True).click()
    assert eventually(lambda: page.evaluate(ground) == dark)


def late(route: Route) -> None:
    time.sleep(0.3)
    route.continue_()


def test_everything_is_reached_by_keyboard(admin: Operator) -> None:
    page = admin.go("maps")
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the content")).to_be_focused()
    button = page.get_by_role("button", name=f"Actions for {LAB}")
    button.focus()
    page.route(f"**/v1/maps/{LAB}", late)  # one dialog follows another
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    expect(page.get_by_role("button", name=f"Edit {LAB}")).to_be_focused()
    page.keyboard.press("Escape")
    expect(button).to_be_focused()
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog", name=f"Edit {LAB}")
    dialog.get_by_label("Description").wait_for()
    page.keyboard.press("Escape")
    dialog.wait_for(state="detached")
    expect(button).to_be_focused()


def test_a_service_without_keys_needs_none(visit: Visit, server: Server, traverse: str) -> None:
    operator = visit(None, server=server)
    page = operator.go("maps")
    page.get_by_role("link", name=traverse, exact=True).wait_for()
    page.get_by_text("No keys: open to this machine").wait_for()
    operator.go(f"maps/{traverse}/plan")
    operator.go("keys")
    page.get_by_text("There are no keys").wait_for()


@pytest.mark.thorough
def test_a_view_that_is_not_there_says_so(admin: Operator) -> None:
    page = admin.go("nowhere")
    expect(page.get_by_role("heading", level=1)).to_have_text("There is no such view")
    admin.foresee("404")
    page.goto(f"{admin.root}/console#/maps/gone/plan")
    page.get_by_role("alert").get_by_text("There is no map 'gone'.").wait_for()
    expect(page.get_by_role("alert")).to_contain_text(re.compile(r"Request [0-9a-f]{32}"))


REDRAW = """async () => {
  dispatchEvent(new Event("hashchange"));
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
}"""
"""Draw the view again, as whatever comes from the service does."""

TYPED = "main input:visible, main textarea:visible, dialog input:visible, dialog textarea:visible"

DIALOGS = {
    "maps": ["Create a map"],
    "keys": ["Create a key"],
    "backups": ["Change the schedule"],
    f"maps/{LAB}/review": ["Stored frames"],
    f"maps/{LAB}/cameras": ["Add a camera"],
    f"maps/{LAB}/places/monday-03": ["Edit"],
    f"maps/{LAB}/calibration": [],
    f"maps/{LAB}/upkeep": [],
}


def type_into(page: Page, where: str) -> int:
    """Type into every field that is shown, and draw the view again after each letter; how many fields there are."""
    fields = page.locator(TYPED)
    count = 0
    for number in range(fields.count()):
        field = fields.nth(number)
        kind = field.get_attribute("type") or "text"
        if kind not in ("text", "number", "datetime-local") or not field.is_enabled():
            continue
        count += 1
        label = f"{where}: {field.evaluate('one => one.labels[0]?.textContent || one.ariaLabel || one.outerHTML')}"
        field.focus()
        if kind == "datetime-local":  # half a date has no value yet
            page.keyboard.type("11")
            page.evaluate(REDRAW)
            assert field.evaluate("one => one.validity.badInput"), label
            continue
        words = "ab1" if kind == "text" else "0.25" if field.get_attribute("step") == "any" else "12"
        page.keyboard.press("ControlOrMeta+a")
        for letter in words:
            page.keyboard.type(letter)
            page.evaluate(REDRAW)
        expect(field, label).to_have_value(words)
    return count


@pytest.mark.thorough
def test_what_is_typed_stays_while_the_view_is_drawn_again(admin: Operator) -> None:
    found = {}
    for view in VIEWS:
        page = admin.go(view)
        found[view] = type_into(page, view)
        for button in DIALOGS.get(view, ()):
            admin.page.goto(f"{admin.root}/console#/{view}")
            admin.settle(view)
            page.get_by_role("button", name=button, exact=True).click()
            page.locator("dialog, form.panel").wait_for()
            found[f"{view}, {button}"] = type_into(page, f"{view}, {button}")
            page.keyboard.press("Escape")
    assert found["audit"] == 5 and found["jobs"] == 1 and found["maps, Create a map"] > 3, found
