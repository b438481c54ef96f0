"""What is generated is what its generator writes today: each file is made anew and compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path

import pytest

from scripts import licences
from service.app import openapi_document
from tests.clients.python import models, twin
from tests.documents import reference
from tests.project.sources import ROOT


def chart() -> Mapping[Path, str]:
    if find_spec("helm_python") is None:
        pytest.skip("Helm's library has a wheel for Linux on x86-64 alone")
    from scripts.manifests import manifests

    return manifests()


GENERATORS: dict[str, Callable[[], Mapping[Path, str]]] = {
    "scripts/openapi": lambda: {ROOT / "openapi.json": openapi_document.document()},
    "scripts/client, from openapi.json": models.files,
    "scripts/client, the synchronous half": twin.files,
    "scripts/reference": reference.files,
    "scripts/chart": chart,
    "python -m scripts.licences page": lambda: {licences.PAGE: licences.page(licences.PAGE.read_text())},
}
"""The files that each command writes, and their text."""


@pytest.mark.parametrize(
    "command",
    [pytest.param(one, marks=pytest.mark.thorough if "licences" in one else ()) for one in GENERATORS],
)
def test_what_is_generated_is_up_to_date(command: str) -> None:
    stale = [path.name for path, text in GENERATORS[command]().items() if path.read_text() != text]
    assert stale == [], f"write anew by {command}"


def test_nothing_generated_is_left_over() -> None:
    assert twin.left_over() == []
    if made := chart():
        assert set(made) == set((ROOT / "docker/kubernetes").rglob("*.yaml"))
