"""The page about compatibility says what the code does."""

from __future__ import annotations

import json
import re
from typing import Any

from core.storage.atlas import FORMAT
from service.errors.problems import KINDS
from tests.project.sources import ROOT
from tests.release.furnishing import FIXTURES

PAGE = (ROOT / "docs/reference/compatibility.md").read_text()
INTERFACE: dict[str, Any] = json.loads((ROOT / "openapi.json").read_text())


def deprecated(part: Any, path: str = "") -> list[str]:
    """The places of the interface that are marked as deprecated."""
    if isinstance(part, list):
        return [found for number, one in enumerate(part) for found in deprecated(one, f"{path}/{number}")]
    if not isinstance(part, dict):
        return []
    own = [path] if part.get("deprecated") is True else []
    return own + [found for name, one in part.items() for found in deprecated(one, f"{path}/{name}")]


def test_nothing_is_deprecated_while_the_page_says_so() -> None:
    """What comes to be deprecated gets the headers that the page promises, and a section of the changelog."""
    found = deprecated(INTERFACE)
    assert bool(found) != ("At present nothing is deprecated." in PAGE), found
    assert bool(found) == ("\n### Deprecated" in (ROOT / "CHANGELOG.md").read_text())


def test_a_mark_is_found() -> None:
    assert deprecated({"paths": {"/v1": {"get": {"parameters": [{"deprecated": True}]}}}}) == [
        "/paths//v1/get/parameters/0"
    ]


def test_refusals_and_files_that_it_names_are_there() -> None:
    slugs = {kind.slug for kind in KINDS.values()}
    named = set(re.findall(r"`([a-z]+(?:-[a-z]+)*-too-new)`", PAGE))
    assert named == {slug for slug in slugs if slug.endswith("-too-new")}
    assert "`tests/fixtures`" in PAGE and FIXTURES.is_dir()
    assert "`FORMAT`" in PAGE and FORMAT.startswith("placerec data ")


def test_paths_without_a_version_are_those_that_it_names() -> None:
    named = {path for path in INTERFACE["paths"] if not path.startswith("/v1/")}
    for path in named:
        assert f"`{path}`" in PAGE, path
