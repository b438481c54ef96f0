"""``placerec settings``: what the environment amounts to."""

from __future__ import annotations

import json

import pytest

from service.settings import Settings
from tests.service.commands.conftest import Placerec


def test_every_setting_is_shown(placerec: Placerec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLACEREC_PORT", "9000")
    items = json.loads(placerec("settings", "--json").stdout)
    by_name = {item["variable"]: item for item in items}
    assert set(by_name) == {f"PLACEREC_{name.upper()}" for name in Settings.model_fields}
    assert by_name["PLACEREC_PORT"]["value"] == 9000
    assert by_name["PLACEREC_PORT"]["default"] == 8000
    assert by_name["PLACEREC_PORT"]["set"]
    assert not by_name["PLACEREC_HOST"]["set"]
    assert by_name["PLACEREC_MODELS_DIR"]["value"].endswith("models")
    assert all(item["description"] for item in items)
    table = placerec("settings").stdout
    assert all(name in table for name in by_name)


def test_mistakes_are_named(placerec: Placerec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLACEREC_PROT", "9000")
    assert "PLACEREC_PROT is set, but there is no such setting" in placerec("settings").stderr
    monkeypatch.setenv("PLACEREC_PORT", "many")
    assert "PLACEREC_PORT: " in placerec("settings", status=1).stderr
