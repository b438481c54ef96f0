"""The locked versions are not below the floors in SECURITY.md."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from tests.project.test_lock import locked, version

ROOT = Path(__file__).parents[2]
FLOORS = dict(re.findall(r"^\| ([a-z0-9-]+) \| ([0-9.]+) \| ", (ROOT / "SECURITY.md").read_text(), re.MULTILINE))

READS_INPUT = {
    *("opencv-python-headless", "starlette", "fastapi", "python-multipart", "uvicorn", "h11", "httptools"),
    *("websockets", "pydantic", "torch", "numpy", "pillow", "simplejpeg", "protobuf"),
}
"""Packages that parse bytes from users; each must have a floor."""


def versions() -> dict[str, Version]:
    found = {name: Version(version(requirement)) for name, requirement in locked("development").items()}
    torch = (ROOT / "requirements/torch.lock").read_text().strip().removeprefix("torch==")
    return {**found, "torch": Version(torch)}


def test_every_package_that_reads_input_has_a_floor() -> None:
    assert set(FLOORS) >= READS_INPUT


@pytest.mark.parametrize("package", sorted(FLOORS))
def test_the_locked_version_is_not_below_its_floor(package: str) -> None:
    assert versions()[package] >= Version(FLOORS[package])


def test_what_pyproject_allows_is_not_below_its_floor() -> None:
    """Who installs without the lock files gets no version with a known flaw either."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"].values()
    lists = [project["project"]["dependencies"], project["build-system"]["requires"], *extras]
    allowed = [Requirement(text) for one in lists for text in one]
    low = [str(one) for one in allowed if one.name in FLOORS and _just_below(FLOORS[one.name]) in one.specifier]
    assert not low


def _just_below(floor: str) -> Version:
    """The last version before a floor, as far as a range can tell: 0.49.1 gives 0.49.0.999, 11.3.0 gives 11.2.999."""
    parts = [int(part) for part in floor.split(".")]
    while parts[-1] == 0:
        parts.pop()
    return Version(".".join(map(str, [*parts[:-1], parts[-1] - 1, 999])))


def test_packages_for_development_stay_there() -> None:
    text = (ROOT / "SECURITY.md").read_text()
    of_development = set(re.findall(r"^\| ([a-z0-9-]+) \|.*development only \|$", text, re.MULTILINE))
    assert of_development and not of_development & set(locked("service"))
