"""All packages have one version, which one command sets."""

from __future__ import annotations

import importlib.metadata
import json
import shutil
from datetime import date
from pathlib import Path

import pytest

from scripts.versions import CHANGES, MADE, PLACES, SOURCE, found, put
from tests.project.sources import ROOT


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The files that have a version, without the rest."""
    for path in {*(place.path for place in (*PLACES, *MADE)), "CHANGELOG.md"}:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, tmp_path / path)
    changes = tmp_path / "CHANGELOG.md"
    changes.write_text(changes.read_text() + "\n## 7.8.9 – not released yet\n")
    return tmp_path


def test_every_package_has_the_same_version() -> None:
    versions = found()
    assert set(versions.values()) == {versions[SOURCE]}, "scripts/versions.py shows where which one stands"
    assert json.loads((ROOT / "openapi.json").read_text())["info"]["version"] == versions[SOURCE]
    assert importlib.metadata.version("placerec") == importlib.metadata.version("placerec-client") == versions[SOURCE]


def test_one_command_sets_it_everywhere(checkout: Path) -> None:
    put("7.8.9", checkout, date(2031, 5, 4))
    versions = found(checkout)
    assert {versions[place] for place in PLACES} == {"7.8.9"}
    for place in PLACES:
        was, now = (root.joinpath(place.path).read_text().splitlines() for root in (ROOT, checkout))
        changed = [line for line, other in zip(was, now, strict=True) if line != other]
        assert len(changed) == sum(one.path == place.path for one in PLACES), "more than the version has changed"
    expected = (ROOT / CHANGES).read_text() + "\n## 7.8.9 – 2031-05-04\n"
    assert (checkout / CHANGES).read_text() == expected, "more than the day of this version has changed"


@pytest.mark.parametrize("version", ["1.0", "v1.0.0", "1.0.0rc1", "6.6.6"])
def test_what_is_no_version_or_has_no_changes_is_refused(version: str, checkout: Path) -> None:
    before = {path: path.read_bytes() for path in checkout.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=r"no version of three numbers|no section"):
        put(version, checkout)
    assert {path: path.read_bytes() for path in before} == before


def test_a_place_without_a_version_is_reported(checkout: Path) -> None:
    (checkout / "docker/chart/Chart.yaml").write_text("name: placerec\n")
    with pytest.raises(ValueError, match=r"Chart\.yaml has 0 versions"):
        put("7.8.9", checkout)
