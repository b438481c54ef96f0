"""Whatever name the console meets, its requests stay with what they are for, or nothing is sent."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import pytest

from service.console.files import FOLDER
from tests.service.console.conftest import Operator
from tests.service.console.world import LAB

OWN = sorted(path for path in FOLDER.rglob("*.js") if "vendor" not in path.parts)
REFUSED = ("", ".", "..", "a/b")
QUOTED = ("%2e%2e", "%2E", "a%2fb", "..\\..", "?x#y;z", "\n", "\u202e", "ü b", "...")
CALL = """async (name) => {
  const api = await import(document.querySelector("link[href$='shared/api.js']").href);
  try {
    await api.remove(api.pathOf("maps", "no-map", "sequences", name));
  } catch (error) {
    return [error.constructor.name, error.title];
  }
}"""


@pytest.mark.thorough
@pytest.mark.parametrize("name", [*REFUSED, *QUOTED], ids=ascii)
def test_a_name_stays_one_segment(admin: Operator, name: str) -> None:
    admin.foresee("404", "422")
    page = admin.go("maps")
    sent: list[str] = []
    page.on("request", lambda request: sent.append(urlsplit(request.url).path) if request.method == "DELETE" else None)
    told: Any = page.evaluate(CALL, name)
    if name in REFUSED:
        assert (sent, told) == ([], ["InvalidName", "This is no name"])
    else:
        assert sent == [f"/v1/maps/no-map/sequences/{quote(name, safe='')}"] and told[0] == "Problem"


@pytest.mark.thorough
@pytest.mark.parametrize("view", ["..", "../places", "../live", "a%2Fb/plan", f"{LAB}/places/.."])
def test_an_address_with_dots_shows_nothing(admin: Operator, view: str) -> None:
    page = admin.go("maps")
    sent: list[str] = []
    page.on("request", lambda request: sent.append(urlsplit(request.url).path))
    page.goto(f"{admin.root}/console#/maps/{view}")
    page.get_by_role("heading", name="There is no such view").wait_for()
    assert [path for path in sent if path.startswith("/v1/maps/")] == []


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.stem)
def test_paths_are_made_in_one_place(path: Path) -> None:
    """Only ``pathOf`` quotes names for a path (``router.js`` those after the #); none is put together by hand."""
    source = path.read_text()
    assert ("encodeURIComponent" in source) == (path.name in ("api.js", "router.js"))
    assert re.findall(r"`/[^`]*\$\{(?!segments\.map)", source) == []
