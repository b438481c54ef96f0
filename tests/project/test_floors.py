"""The locked versions are not below the floors in SECURITY.md."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
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


def test_packages_for_development_stay_there() -> None:
    text = (ROOT / "SECURITY.md").read_text()
    of_development = set(re.findall(r"^\| ([a-z0-9-]+) \|.*development only \|$", text, re.MULTILINE))
    assert of_development and not of_development & set(locked("service"))
