"""Maps: create, list, read, edit, delete, verify."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest

from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from tests.service.damage import damage
from tests.service.map_jobs import finished
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem


def test_a_new_map_shows_its_identity_and_defaults(client: httpx.Client) -> None:
    response = client.post("/v1/maps", json={"id": "lab", "encoder": "m-region-vlad", "description": "Zweiter Stock ✓"})
    assert response.status_code == 201
    assert response.headers["location"] == "/v1/maps/lab"
    made = response.json()
    assert made["encoder"].startswith("m-region-vlad@") and len(made["encoder"]) == len("m-region-vlad@") + 64
    assert made["calibration"]["source"] == "encoder-default"
    assert {"threshold", "margin"} <= set(made["calibration"])
    assert (made["keep"], made["places"], made["revision"]) == ("thumbnail", 0, 1)
    assert made["description"] == "Zweiter Stock ✓"
    read = client.get("/v1/maps/lab")
    assert read.json() == made and read.headers["etag"] == response.headers["etag"]


def test_a_map_takes_a_full_identity_and_settings(server: Server) -> None:
    encoders = {item["name"]: item["identity"] for item in server.client.get("/v1/encoders").json()["items"]}
    made = server.create_map(
        "chosen", encoder=encoders["region-vlad"], keep="none", same_place_radius=2.5, same_place_frames=0
    )
    assert made["encoder"] == encoders["region-vlad"]
    assert (made["keep"], made["same_place_radius"], made["same_place_frames"]) == ("none", 2.5, 0)


def test_a_map_exists_once(client: httpx.Client, map_id: str) -> None:
    assert_problem(client.post("/v1/maps", json={"id": map_id}), 409, "map-exists")


@pytest.mark.parametrize(
    "name",
    ["", "import", "Upper", ".hidden", "-dash", "a" * 65, "with space", "a/b", "ä", "nul\x00", "../etc", "new\n"],
)
def test_bad_names(client: httpx.Client, name: str) -> None:
    assert_problem(client.post("/v1/maps", json={"id": name}), 422, "invalid-identifier")


@pytest.mark.parametrize("path", ["Upper", "%C3%A4", "a%00b", "import", "a" * 65, "%2E", "%FF"])
def test_bad_names_in_paths(client: httpx.Client, path: str) -> None:
    response = client.get(f"/v1/maps/{path}")
    assert response.status_code == 422
    assert response.json()["type"].endswith("invalid-identifier")


@pytest.mark.parametrize("name", ["a", "0", "a" * 64, "a.b_c-d"])
def test_good_names(client: httpx.Client, name: str) -> None:
    assert client.post("/v1/maps", json={"id": name}).status_code == 201


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", ""),
        ("PATCH", ""),
        ("DELETE", ""),
        ("POST", "/verify"),
        ("GET", "/places"),
        ("GET", "/places/p1"),
        ("GET", "/sequences"),
        ("DELETE", "/sequences/s"),
        ("GET", "/places/p1/thumbnail"),
    ],
)
def test_an_unknown_map(client: httpx.Client, method: str, path: str) -> None:
    body: dict[str, str] | None = {} if method == "PATCH" else None
    assert_problem(client.request(method, f"/v1/maps/nowhere{path}", json=body), 404, "unknown-map")


@pytest.mark.parametrize("encoder", ["absent", "m-region-vlad@" + "0" * 64, "", "@", "x" * 300, "../../etc/passwd"])
def test_an_unknown_encoder(client: httpx.Client, encoder: str) -> None:
    response = client.post("/v1/maps", json={"id": "never", "encoder": encoder})
    if encoder == "":  # left out, in other words
        assert response.status_code == 201
        return
    assert_problem(response, 422, "invalid-request" if len(encoder) > 256 else "unknown-encoder")


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"id": 7},
        {"id": "x", "keep": "everything"},
        {"id": "x", "same_place_radius": -1},
        {"id": "x", "same_place_frames": 1.5},
        {"id": "x", "colour": "red"},
        {"id": "x", "description": "d" * 2001},
        ["x"],
        "x",
    ],
)
def test_a_map_that_does_not_fit_the_contract(client: httpx.Client, body: object) -> None:
    problem = assert_problem(client.post("/v1/maps", json=body), 422, "invalid-request")
    assert problem["errors"]


@pytest.mark.parametrize(
    ("content", "status", "slug"),
    [
        (b"{", 400, "malformed-body"),
        (b"", 422, "invalid-request"),
        (b"\xff\xfe\xfa", 400, "malformed-body"),
        (b"[" * 100_000, 400, "malformed-body"),
        (b'{"id": "x", "same_place_radius": NaN}', 422, "invalid-request"),
        (b'{"id": "x", "same_place_radius": 1e999}', 422, "invalid-request"),
        (b'{"id": "x", "description": "\\ud800"}', 422, "invalid-request"),
        (b'{"id": "x", "same_place_frames": ' + b"9" * 5000 + b"}", 400, "malformed-body"),
    ],
)
def test_bodies_that_are_not_json(client: httpx.Client, content: bytes, status: int, slug: str) -> None:
    response = client.post("/v1/maps", content=content, headers={"Content-Type": "application/json"})
    assert_problem(response, status, slug)


@pytest.mark.parametrize("content_type", [None, "text/plain", "image/jpeg", "multipart/form-data", "nonsense"])
def test_a_map_is_sent_as_json(client: httpx.Client, content_type: str | None) -> None:
    headers = {} if content_type is None else {"Content-Type": content_type}
    response = client.post("/v1/maps", content=b'{"id": "typed"}', headers=headers)
    assert_problem(response, 415, "unsupported-media-type")


def test_listing_by_pages(server: Server) -> None:
    names = [f"page-{letter}" for letter in "abcde"]
    for name in names:
        server.create_map(name)
    seen: list[str] = []
    cursor = None
    while True:
        page = server.client.get("/v1/maps", params={"limit": 2, **({"cursor": cursor} if cursor else {})}).json()
        assert len(page["items"]) <= 2
        seen += [item["id"] for item in page["items"]]
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert seen == sorted(seen) and set(names) <= set(seen) and len(set(seen)) == len(seen)


@pytest.mark.parametrize(
    "parameters",
    [
        {"limit": 0},
        {"limit": 1001},
        {"limit": "all"},
        {"offset": 3},
        {"cursor": "x" * 2000},
        [("limit", 1), ("limit", 2)],
    ],
)
def test_bad_page_parameters(client: httpx.Client, parameters: dict[str, str]) -> None:
    assert_problem(client.get("/v1/maps", params=parameters), 422, "invalid-request")


@pytest.mark.parametrize("cursor", ["", "nonsense", "\x00", "ä", "AAAA", "bnVsbA", "-", "=", "e30"])
def test_bad_cursors(client: httpx.Client, map_id: str, cursor: str) -> None:
    for path in ("/v1/maps", f"/v1/maps/{map_id}/places", f"/v1/maps/{map_id}/sequences"):
        assert_problem(client.get(path, params={"cursor": cursor}), 422, "invalid-cursor")


def test_a_cursor_belongs_to_its_listing(server: Server, map_id: str) -> None:
    for number in range(2):
        server.enrol(map_id, f"p{number}", jpeg(number), sequence=f"s{number}")
    cursor = server.client.get(f"/v1/maps/{map_id}/places", params={"limit": 1}).json()["next_cursor"]
    assert cursor
    for path in ("/v1/maps", f"/v1/maps/{map_id}/sequences", "/v1/maps/traverse/places"):
        if path == "/v1/maps/traverse/places" and server.client.get("/v1/maps/traverse").status_code == 404:
            continue
        assert_problem(server.client.get(path, params={"cursor": cursor}), 422, "invalid-cursor")


def test_editing_insists_on_what_was_read(client: httpx.Client, map_id: str) -> None:
    path = f"/v1/maps/{map_id}"
    first = client.get(path).headers["etag"]
    edited = client.patch(path, json={"description": "by night"}, headers={"If-Match": first})
    assert edited.status_code == 200 and edited.json()["description"] == "by night"
    assert edited.headers["etag"] != first
    assert_problem(client.patch(path, json={"keep": "none"}, headers={"If-Match": first}), 412, "revision-mismatch")
    assert client.get(path).json()["keep"] == "thumbnail", "nothing of the refused edit was kept"
    for header in ("*", edited.headers["etag"], f'"99", {edited.headers["etag"]}'):
        current = client.get(path).headers["etag"]
        header = header.replace(edited.headers["etag"], current)
        assert client.patch(path, json={"keep": "image"}, headers={"If-Match": header}).status_code == 200
    for header in ("nonsense", 'W/"1"', '"1x"', ""):
        assert client.patch(path, json={"keep": "none"}, headers={"If-Match": header}).status_code == 412
    assert client.patch(path, json={"keep": "none"}).status_code == 200, "without the header anything goes"


def test_editing_is_a_merge_patch(client: httpx.Client, map_id: str) -> None:
    path = f"/v1/maps/{map_id}"
    headers = {"Content-Type": "application/merge-patch+json"}
    set_ = client.patch(path, content=json.dumps({"same_place_radius": 9, "description": "x"}), headers=headers).json()
    assert (set_["same_place_radius"], set_["description"], set_["same_place_frames"]) == (9, "x", 3)
    assert client.patch(path, json={"same_place_height": 3}).json()["same_place_height"] == 3
    reset = client.patch(path, json={"same_place_radius": None, "same_place_height": None}).json()
    assert reset["same_place_height"] == 1.5
    assert (reset["same_place_radius"], reset["description"]) == (5, "x")
    assert client.patch(path, json={}).json()["revision"] == reset["revision"], "nothing changed"


def test_a_calibration_set_by_hand(client: httpx.Client, map_id: str) -> None:
    path = f"/v1/maps/{map_id}"
    default = client.get(path).json()["calibration"]
    own = client.patch(path, json={"calibration": {"threshold": 0.75}}).json()["calibration"]
    assert own == default | {"source": "manual", "threshold": 0.75}
    more = client.patch(path, json={"calibration": {"margin": 0.5}}).json()["calibration"]
    assert (more["threshold"], more["margin"]) == (0.75, 0.5)
    back = client.patch(path, json={"calibration": {"threshold": None}}).json()["calibration"]
    assert (back["threshold"], back["margin"]) == (default["threshold"], 0.5)
    assert client.patch(path, json={"calibration": None}).json()["calibration"] == default


def test_a_threshold_out_of_reach_is_refused(client: httpx.Client, map_id: str) -> None:
    path = f"/v1/maps/{map_id}"
    refused = client.patch(path, json={"calibration": {"threshold": 5}})
    assert refused.status_code == 422 and refused.json()["type"].endswith("invalid-request")
    assert "from -1 to 1" in refused.json()["detail"]
    for edge in (-1.0, 1.0):
        assert client.patch(path, json={"calibration": {"threshold": edge}}).is_success


@pytest.mark.parametrize(
    "changes",
    [
        {"id": "other"},
        {"encoder": "region-vlad"},
        {"revision": 7},
        {"keep": "all"},
        {"same_place_radius": -1},
        {"calibration": {"source": "me"}},
        {"calibration": {"margin": -1}},
        {"calibration": {"threshold": 1.01}},
        {"calibration": {"threshold": -1.01}},
        {"calibration": 3},
        [],
    ],
)
def test_what_cannot_be_edited(client: httpx.Client, map_id: str, changes: object) -> None:
    before = client.get(f"/v1/maps/{map_id}").json()
    assert_problem(client.patch(f"/v1/maps/{map_id}", json=changes), 422, "invalid-request")
    assert client.get(f"/v1/maps/{map_id}").json() == before


def test_deleting(server: Server, map_id: str) -> None:
    client, path = server.client, f"/v1/maps/{map_id}"
    server.enrol(map_id, "p1", jpeg(1))
    assert_problem(client.delete(path, headers={"If-Match": '"99"'}), 412, "revision-mismatch")
    response = client.delete(path)
    assert (response.status_code, response.content) == (204, b"")
    assert_problem(client.delete(path), 404, "unknown-map")
    assert map_id not in [item["id"] for item in client.get("/v1/maps", params={"limit": 1000}).json()["items"]]
    made = server.create_map(map_id)
    assert made["places"] == 0, "nothing of the old one is left"


def test_verifying(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p1", jpeg(1))
    report = server.client.post(f"/v1/maps/{map_id}/verify").json()
    assert report["ok"] and report["places"] == 1 and report["problems"] == []
    cells, values = EncoderCatalogue().get(DEFAULT_ENCODER).local_shape
    dimension = server.client.get(f"/v1/maps/{map_id}").json()["dimension"]
    assert report["checked_bytes"] > 2 * dimension + cells * values


@pytest.mark.thorough
def test_after_a_kill_a_damaged_map_is_quarantined_and_the_others_serve(tmp_path: Path) -> None:
    server, mask = Server(tmp_path).wait(), {"polygons": [[[0, 0.6], [1, 0.6], [1, 1], [0, 1]]]}
    for name in ("bad", "good"):
        server.create_map(name)
        assert server.enrol(name, "p1", jpeg(1)).status_code == 201
    assert server.client.put("/v1/maps/good/cameras/front", json={"mask": mask}).status_code == 201
    assert server.enrol("good", "masked", jpeg(2), camera="front").status_code == 201
    server.kill()
    damage(tmp_path / "data", "bad")

    server = Server(tmp_path).wait()
    client = server.client
    problem = assert_problem(client.get("/v1/maps/bad"), 503, "map-quarantined")
    assert "damaged" in problem["detail"]
    listing = client.get("/v1/maps").json()
    assert [item["id"] for item in listing["items"]] == ["good"]
    assert [item["id"] for item in listing["quarantined"]] == ["bad"]
    assert client.get("/readyz").json()["quarantined"][0]["id"] == "bad"
    assert server.query("good", jpeg(1))["matches"][0]["place"]["id"] == "p1"
    assert client.get("/v1/maps/good/cameras/front").json()["mask"] == mask
    assert server.enrol("good", "masked", jpeg(2), camera="front").json()["change"] == "unchanged"
    assert "placerec_quarantined_maps 1.0" in client.get("/metrics").text
    report = client.post("/v1/maps/bad/verify").json()
    assert not report["ok"] and report["problems"]
    assert client.delete("/v1/maps/bad").status_code == 204
    assert server.stop() == 0


def test_how_a_map_is_searched_is_shown_and_chosen(server: Server) -> None:
    made = server.create_map("tiers", precision="compressed")
    path = "/v1/maps/tiers"
    assert (made["index"]["setting"], made["index"]["tier"], made["index"]["state"]) == ("auto", "exact", "ready")
    assert made["storage"]["precision"] == "compressed" and made["storage"]["bytes_per_place"] == 0
    for index in range(3):
        server.enrol("tiers", f"p{index}", jpeg(index))
    view = server.client.patch(path, json={"index": "compact"}, headers={"If-Match": "*"}).json()
    assert (view["index"]["setting"], view["index"]["wanted"]) == ("compact", "compact")
    assert finished(server, server.client.post(f"{path}/rebuild").json())["state"] == "succeeded"
    view = server.client.get(path).json()
    assert (view["index"]["tier"], view["index"]["rows_indexed"]) == ("compact", 3)
    assert view["index"]["recall"] == {"at_1": 1.0, "queries": 128, "shortlist": 100, "places": 3}
    files = view["storage"]["descriptors"] + view["storage"]["index"] + view["storage"]["database"]
    assert view["storage"]["bytes_per_place"] == round(files / 3)
    for index in range(3):
        assert server.query("tiers", jpeg(index))["matches"][0]["place"]["id"] == f"p{index}"
    assert server.client.patch(path, json={"index": None}).json()["index"]["setting"] == "auto"
    assert server.client.post(f"{path}/verify").json()["ok"]
    assert_problem(server.client.patch(path, json={"index": "fast"}), 422, "invalid-request")
    assert_problem(server.client.patch(path, json={"precision": "half"}), 422, "invalid-request")
    assert_problem(server.client.post("/v1/maps", json={"id": "q", "precision": "full"}), 422, "invalid-request")
