"""The plan in the console: lines from afar, discs near, the grid, the lasso, a floor plan, and strips of pictures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.service.console import world
from tests.service.console.conftest import Operator, Visit
from tests.service.console.world import LAB
from tests.service.server import Server
from tests.service.wire import eventually

THICKNESS = """canvas => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const { data } = copy.getImageData(Math.round(canvas.width / 2), 0, 1, canvas.height);
  return data.filter((value, at) => at % 4 === 3 && value > 100).length;
}"""
"""How many pixels of the middle column are painted."""

PIXEL = """(canvas, share) => {
  const { width, height } = canvas;
  const copy = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  copy.drawImage(canvas, 0, 0);
  const { data } = copy.getImageData(Math.round(share * width), Math.round(height / 2), 1, 1);
  return [...data];
}"""


CLICK_AND_TYPE = """([image, field, text]) => {
  image.click();
  field.select();
  document.execCommand('insertText', false, text);
}"""
"""A click into the picture and a text into a field, before the page is drawn again."""


def thickness(page: Page, canvas: str = "places") -> int:
    found: int = page.locator(f".plan-canvas canvas.{canvas}").evaluate(THICKNESS)
    return found


def test_a_traverse_is_a_line_from_afar_and_discs_near(admin: Operator, keyed: Server) -> None:
    told: dict[str, Any] = keyed.client.get(f"/v1/maps/{LAB}/plan").json()
    count = 3001
    told |= {name: None for name, column in told.items() if isinstance(column, list) and len(column) == told["places"]}
    told |= {"ids": [f"p{number}" for number in range(count)], "x": list(range(count)), "y": [0] * count}
    told |= {"sequences": ["walk"], "sequence": [0] * count, "places": count, "flags": [0] * count, "gaps": []}
    admin.page.route(f"**/v1/maps/{LAB}/plan", lambda route: route.fulfill(json=told))
    page = admin.go(f"maps/{LAB}/plan")
    assert eventually(lambda: 1 <= thickness(page) <= 3), thickness(page)
    page.get_by_role("img", name=re.compile("Plan of lab")).focus()
    for _ in range(24):
        page.keyboard.press("+")
    assert eventually(lambda: thickness(page) >= 5), thickness(page)
    page.keyboard.press("0")
    assert eventually(lambda: 1 <= thickness(page) <= 3), thickness(page)


def test_the_grid_coordinates_and_the_picture_of_what_is_pointed_at(admin: Operator) -> None:
    page = admin.go(f"maps/{LAB}/plan")
    page.get_by_role("img", name="x to the right, y up").wait_for()
    canvas = page.get_by_role("img", name=re.compile("Plan of lab"))
    assert eventually(lambda: thickness(page) > 0), "before it is drawn, no point of it lies anywhere"
    box = canvas.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.get_by_text(re.compile(r"^−?0\.\d\d, −?0\.\d\d m$")).wait_for()  # the middle of the loop
    page.get_by_label("Find a place").fill("monday-04")
    page.get_by_role("button", name="Find", exact=True).click()
    page.get_by_role("button", name="Choose none").click()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.locator(".hovered").get_by_role("img", name="Place monday-04").wait_for()
    assert thickness(page, "ground") == 0
    page.get_by_label("Grid, in metres").check()
    assert eventually(lambda: thickness(page, "ground") > 0)


@pytest.mark.thorough
def test_places_are_caught_with_a_lasso_compared_and_deleted(visit: Visit, keyed: Server) -> None:
    world.copy(keyed, "lassoed")
    operator = visit("enrol")
    page = operator.go("maps/lassoed/plan")
    canvas = page.get_by_role("img", name=re.compile("Plan of lassoed"))
    assert eventually(lambda: thickness(page) > 0), "what is not drawn is not caught"
    box = canvas.bounding_box()
    assert box is not None
    page.get_by_role("button", name="Lasso").click()
    left, top, right, bottom = box["x"] + 2, box["y"] + 2, box["x"] + box["width"] / 2, box["y"] + box["height"] - 2
    page.mouse.move(left, top)
    page.mouse.down()
    for point in ((right, top), (right, bottom), (left, bottom)):
        page.mouse.move(*point, steps=3)
    page.mouse.up()
    caught = page.get_by_role("region", name="Within the lasso")
    places = keyed.places("lassoed")
    wanted = {place for place, told in places.items() if told["pose"]["x"] < -1}
    expect(caught.get_by_role("heading")).to_have_text(re.compile(rf"{len(wanted)}|{len(wanted) + 2} places"))
    expect(caught.get_by_role("link", name=re.compile("Compare"))).to_have_text("Compare tuesday with monday")
    operator.foresee("lassoed/places/")  # pictures of what is deleted may still be on their way
    caught.get_by_role("button", name="Delete …").click()
    dialog = page.get_by_role("dialog")
    assert keyed.places("lassoed").keys() == places.keys(), "it asks first"
    dialog.get_by_role("textbox").fill("lassoed")
    dialog.get_by_role("button", name="Delete", exact=True).click()
    caught.wait_for(state="detached")
    left_over = keyed.places("lassoed")
    assert not wanted & left_over.keys() and all(told["pose"]["x"] > -3 for told in left_over.values())


@pytest.mark.thorough
def test_a_floor_plan_is_laid_by_two_places_and_stays_in_the_browser(admin: Operator, tmp_path: Path) -> None:
    picture = np.zeros((100, 200, 3), np.uint8)
    picture[:, :100, 2], picture[:, 100:, 0] = 255, 255  # red, then blue
    cv2.imwrite(str(tmp_path / "floor.png"), picture)
    page = admin.go(f"maps/{LAB}/plan")
    page.get_by_role("button", name="Lay a floor plan …").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Picture").set_input_files(tmp_path / "floor.png")
    image = dialog.get_by_role("img", name="The floor plan")
    lay = dialog.get_by_role("button", name="Lay it")
    dialog.get_by_label("Place 1", exact=True).fill("monday-06")  # at x = -12
    dialog.get_by_label("Place 2", exact=True).fill("monday-00")  # at x = 12
    dialog.get_by_label("Place 1", exact=True).focus()
    expect(lay).to_be_disabled()
    box = image.bounding_box()
    assert box is not None
    image.click(position={"x": 0.1 * box["width"], "y": 0.5 * box["height"]})
    image.click(position={"x": 0.5 * box["width"], "y": 0.5 * box["height"]})
    across = dialog.get_by_label("Place 2, % from the left")
    expect(across).to_have_value("50")
    dialog.get_by_label("Place 2", exact=True).focus()
    page.evaluate(CLICK_AND_TYPE, [image.element_handle(), across.element_handle(), "90"])
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => setTimeout(done, 50)))")
    expect(across).to_have_value("90")
    lay.click()
    dialog.wait_for(state="detached")
    ground = page.locator(".plan-canvas canvas.ground")

    def colours() -> list[int]:
        """The strongest channels a quarter from the left and from the right; red is 0, blue 2, nothing -1."""
        found = []
        for share in (0.25, 0.75):
            *channels, alpha = ground.evaluate(PIXEL, share)
            found.append(int(np.argmax(channels)) if alpha else -1)
        return found

    assert eventually(lambda: colours() == [0, 2]), colours()
    page.reload()
    admin.settle()
    assert eventually(lambda: colours() == [0, 2]), "the browser has kept it"
    page.get_by_role("button", name="Remove it").click()
    assert eventually(lambda: colours() == [-1, -1])


@pytest.mark.thorough
def test_traverses_without_poses_are_strips_of_pictures(admin: Operator, keyed: Server) -> None:
    keyed.create_map("strips")
    for number in range(4):
        keyed.enrol("strips", f"s{number}", world.frame(number), sequence="walk")
    page = admin.go("maps/strips/plan")
    strip = page.get_by_role("group", name="Pictures of walk")
    expect(strip.get_by_role("img")).to_have_count(4)
    strip.get_by_role("link", name="Place s2").click()
    page.wait_for_url("**/places/s2")
