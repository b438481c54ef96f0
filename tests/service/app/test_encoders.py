"""The encoders installed."""

from __future__ import annotations

from core.method.catalogue import DEFAULT_ENCODER
from tests.service.encoders import COARSE, SECOND_STAGE, TWO_STAGES
from tests.service.server import Server


def test_packaged_and_installed_encoders_are_listed(server: Server) -> None:
    page = server.client.get("/v1/encoders").json()
    assert page["next_cursor"] is None
    found = {item["name"]: item for item in page["items"]}
    assert {DEFAULT_ENCODER, "region-vlad", COARSE, TWO_STAGES} <= set(found)
    assert [name for name, item in found.items() if item["default"]] == [DEFAULT_ENCODER]
    assert (found[DEFAULT_ENCODER]["source"], found[COARSE]["source"]) == ("packaged", "installed")
    for name, item in found.items():
        assert item["identity"].startswith(f"{name}@") and item["damaged"] is None
        assert item["dimension"] > 0 and item["definition"]["layers"] and item["calibration"]["threshold"]


def test_the_second_stage_is_shown(server: Server) -> None:
    found = {item["name"]: item["definition"] for item in server.client.get("/v1/encoders").json()["items"]}
    assert found[TWO_STAGES]["agreement"] == SECOND_STAGE.model_dump(mode="json")
    assert found[COARSE]["agreement"] is None


def test_a_damaged_model_is_listed_and_harms_nobody(server: Server) -> None:
    damaged = server.folder / "models" / "broken.encoder.safetensors"
    damaged.write_bytes(b"not a model")
    try:
        found = {item["name"]: item for item in server.client.get("/v1/encoders").json()["items"]}
        assert found["broken"]["damaged"] and found[DEFAULT_ENCODER]["damaged"] is None
        response = server.client.post("/v1/maps", json={"id": "on-broken", "encoder": "broken"})
        assert response.status_code == 503
        assert response.json()["type"].endswith("invalid-model")
    finally:
        damaged.unlink()
