"""Verification over HTTP: when candidates are verified, what answers say of it, and maps that lack keypoints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.judgement.geometry import AGREEMENT, INLIERS, SIMILARITY
from core.recognition.verification import CANDIDATES
from tests.service.map_jobs import asked, finished
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again, stranger
from tests.service.server import Server, assert_problem

PLACES = 12


@pytest.fixture(scope="module")
def verified(server: Server) -> Iterator[str]:
    """A map of places of their own, which keeps keypoints."""
    server.create_map("verified", keep="image")
    for seed in range(PLACES):
        assert server.enrol("verified", f"p{seed}", jpeg(seed)).status_code == 201
    yield "verified"


def seen(seed: int) -> bytes:
    return encoded(seen_again(scene(seed)))


def parts(answer: dict[str, Any]) -> list[dict[str, Any]]:
    return [match["parts"] for match in answer["matches"]]


@pytest.mark.thorough
def test_always_tells_the_parts_of_each_match(server: Server, verified: str) -> None:
    answer = server.query(verified, seen(3), verify="always", k=PLACES)
    assert answer["verdict"] == "recognized" and answer["place"]["id"] == "p3"
    verified_ = answer["verification"]
    assert verified_["state"] == "verified" and 1 < verified_["candidates"] <= CANDIDATES
    assert verified_["keypoints"] > 100 and answer["milliseconds"]["verify"] > 0
    for match in answer["matches"]:
        told = match["parts"]
        assert match["score"] == pytest.approx(told["similarity"] + told["agreement"] + told["geometry"], abs=1e-6)
        inliers = 0 if told["inliers"] is None else told["inliers"] / told["keypoints"]
        gain = INLIERS * inliers + SIMILARITY * told["similarity"] - AGREEMENT * told["agreement"]
        assert told["geometry"] == pytest.approx(gain, abs=1e-6)
    best, *others = parts(answer)
    assert 20 < best["inliers"] <= best["keypoints"] and best["evidence"] > 80
    scores = [match["score"] for match in answer["matches"]]
    assert scores == sorted(scores, reverse=True) and answer["score"] == scores[0]
    assert [one["inliers"] is None for one in others].count(True) == PLACES - verified_["candidates"]


@pytest.mark.parametrize("verify", ["never", "auto", "always"])
def test_the_same_frame_is_found_however_it_is_verified(server: Server, verified: str, verify: str) -> None:
    answer = server.query(verified, seen(7), verify=verify)
    assert answer["matches"][0]["place"]["id"] == "p7"
    assert (answer["verification"]["state"] == "never") == (verify == "never")
    assert answer["revision"] == 1


@pytest.mark.thorough
def test_strangers_are_not_recognized_in_a_map_of_one_place(server: Server, map_id: str) -> None:
    server.enrol(map_id, "only", jpeg(1))
    for verify in ("auto", "always"):
        assert server.query(map_id, seen(1), verify=verify)["place"]["id"] == "only"
        verdicts = [server.query(map_id, encoded(stranger(seed)), verify=verify)["verdict"] for seed in range(100, 110)]
        assert verdicts.count("unknown") >= 9, verdicts


def test_twins_are_ambiguous(server: Server, map_id: str) -> None:
    for place in ("here", "there"):
        server.enrol(map_id, place, jpeg(1) + (b"" if place == "here" else b"\0"))
    answer = server.query(map_id, jpeg(1), verify="always")
    assert answer["verdict"] == "ambiguous" and answer["place"] is None
    assert {place for group in answer["rivals"] for place in group["places"]} <= {"here", "there"}


FLAT = (37, 39, 42, 47)
"""Scenes of which OpenCV finds no fundamental matrix between the picture and itself."""
REAL = (
    "eval/corridor/query/0000015.jpg",
    "eval/lip6_outdoor/query/000615.jpg",
    "train/camvid/0001TP_006690.jpg",
    "train/tower/floor12/f12_elevator_main_frame_000010.jpg",
)
"""Likewise."""
DATASETS = Path(__file__).parents[4] / "shared/datasets"


@pytest.mark.thorough
@pytest.mark.parametrize("seed", FLAT)
def test_a_place_is_recognized_by_its_own_picture(server: Server, map_id: str, seed: int) -> None:
    server.enrol(map_id, "only", jpeg(seed))
    for verify in ("auto", "always"):
        answer = server.query(map_id, jpeg(seed), verify=verify)
        assert answer["verdict"] == "recognized" and answer["place"]["id"] == "only", answer
        (told,) = parts(answer)
        assert told["inliers"] > 0.9 * told["keypoints"] and told["evidence"] > 1000


@pytest.mark.thorough
@pytest.mark.parametrize("picture", REAL)
@pytest.mark.skipif(not DATASETS.is_dir(), reason="the pictures of ../shared/datasets are not here")
def test_a_real_place_is_recognized_by_its_own_picture(server: Server, map_id: str, picture: str) -> None:
    data = (DATASETS / picture).read_bytes()
    server.enrol(map_id, "only", data)
    assert server.query(map_id, data)["place"]["id"] == "only"
    server.enrol(map_id, "elsewhere", data + b"\0", x=500, y=0)
    assert server.query(map_id, data, verify="always")["verdict"] == "ambiguous"


@pytest.mark.parametrize("seed", FLAT[:2])
def test_equal_pictures_that_are_apart_are_rivals(server: Server, map_id: str, seed: int) -> None:
    for x in (0, 500):
        server.enrol(map_id, f"at-{x}", jpeg(seed) + b"\0" * (x > 0), x=x, y=0)
    answer = server.query(map_id, jpeg(seed), verify="always")
    assert answer["verdict"] == "ambiguous" and answer["place"] is None, answer
    assert {place for group in answer["rivals"] for place in group["places"]} <= {"at-0", "at-500"}


def test_a_batch_is_verified_too(server: Server, verified: str) -> None:
    files = {f"f{seed}": (f"f{seed}", seen(seed), "image/jpeg") for seed in (2, 5)}
    response = server.client.post(f"/v1/maps/{verified}/query:batch", params={"verify": "always"}, files=files)
    answers = [item["answer"] for item in response.json()["items"]]
    assert [answer["place"]["id"] for answer in answers] == ["p2", "p5"]
    assert all(answer["verification"]["state"] == "verified" for answer in answers)


def test_several_maps_are_verified_for_one_frame(server: Server, verified: str) -> None:
    params = {"maps": verified, "verify": "always"}
    response = server.client.post("/v1/query", params=params, content=seen(4), headers={"Content-Type": "image/jpeg"})
    (answer,) = response.json()["maps"]
    assert answer["verification"]["state"] == "verified" and response.json()["place"]["id"] == "p4"


def test_the_inliers_are_explained_and_drawn(server: Server, verified: str) -> None:
    answer = server.query(verified, seen(3), verify="always", explain=True)
    inliers = answer["explanation"]["inliers"]
    assert len(inliers) == answer["matches"][0]["parts"]["inliers"]
    assert all(0 <= share <= 1 for pair in inliers for end in (pair["query"], pair["match"]) for share in end)
    picture = server.client.get(answer["explanation"]["picture"])
    assert picture.status_code == 200 and picture.headers["content-type"] == "image/png"
    assert server.query(verified, seen(3), verify="never", explain=True)["explanation"]["inliers"] == []


@pytest.mark.thorough
def test_a_map_without_keypoints_says_so_and_answers_by_two_stages(server: Server) -> None:
    server.create_map("without-keypoints", verification=False, keep="thumbnail")
    for seed in range(3):
        server.enrol("without-keypoints", f"p{seed}", jpeg(seed))
    answers = {verify: server.query("without-keypoints", seen(1), verify=verify) for verify in ("never", "always")}
    assert answers["always"]["verification"] == {"state": "no-keypoints", "candidates": 0, "keypoints": None}
    for name in ("verdict", "probability", "score", "margin", "decision"):
        assert answers["always"][name] == answers["never"][name]
    result = finished(server, asked(server, "without-keypoints", "keypoints"))["result"]
    assert result["found"] == 0  # the setting says that it keeps none
    edited = server.client.patch("/v1/maps/without-keypoints", json={"verification": True})
    assert edited.status_code == 200, edited.text
    job = finished(server, asked(server, "without-keypoints", "keypoints"))
    assert job["state"] == "succeeded" and job["result"]["found"] == 3 and job["result"]["without"] == 0, job["result"]
    answer = server.query("without-keypoints", seen(1), verify="always")
    assert answer["verification"]["state"] == "verified" and answer["place"]["id"] == "p1"
    assert finished(server, asked(server, "without-keypoints", "keypoints"))["result"]["found"] == 0


def test_a_loop_closure_is_verified_and_enrols_keypoints(server: Server, map_id: str) -> None:
    def ask(seed: int, place: str) -> dict[str, Any]:
        params = {"id": place, "verify": "always"}
        headers = {"Content-Type": "image/jpeg"}
        answer = server.client.post(
            f"/v1/maps/{map_id}/query:enrol", params=params, content=seen(seed), headers=headers
        )
        found: dict[str, Any] = answer.json()
        return found

    assert ask(1, "first")["enrolment"] == "created"
    again = ask(1, "again")
    assert again["enrolment"] is None and again["verification"]["state"] == "verified"
    assert again["place"]["id"] == "first"


def test_a_blank_frame_and_a_wrong_word_are_answered_clearly(server: Server, verified: str) -> None:
    assert server.query(verified, encoded(blank()), verify="always")["reason"] == "no-regions"
    response = server.client.post(
        f"/v1/maps/{verified}/query?verify=sometimes", content=seen(1), headers={"Content-Type": "image/jpeg"}
    )
    assert_problem(response, 422, "invalid-request")


INTRINSICS = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 160.0, "cy": 120.0}


@pytest.fixture(scope="module")
def posed(server: Server) -> str:
    """A map of posed places, taken by a camera whose intrinsics it knows."""
    server.create_map("posed")
    assert server.client.put("/v1/maps/posed/cameras/front", json={"intrinsics": INTRINSICS}).status_code in (200, 201)
    for seed in range(4):
        server.enrol("posed", f"p{seed}", jpeg(seed), x=20 * seed, y=0, heading=90, camera="front")
    return "posed"


def test_geometry_tells_the_pose_where_the_intrinsics_are_known(server: Server, posed: str) -> None:
    pose = server.query(posed, jpeg(2), verify="always", camera="front")["pose"]
    assert pose["source"] == "intrinsics" and "note" not in pose
    assert abs(pose["x"] - 40) < 1 and abs(pose["heading"] - 90) < 2 and abs(pose["heading_offset"]) < 2
    covariance = np.array(pose["covariance"]).reshape(6, 6)
    assert np.allclose(covariance, covariance.T) and (np.linalg.eigvalsh(covariance) > 0).all()


def test_a_camera_of_another_angle_is_told(server: Server, posed: str) -> None:
    lenses = {"wide": 150.0, "similar": 250.0, "narrow": 600.0, "unknown": None}
    for name, focal in lenses.items():
        lens = None if focal is None else INTRINSICS | {"fx": focal, "fy": focal}
        server.client.put(f"/v1/maps/{posed}/cameras/{name}", json={"intrinsics": lens}).raise_for_status()
    notes = {name: server.query(posed, jpeg(2), camera=name).get("note") for name in (*lenses, "front")}
    assert "'wide' sees 1.7 times the angle that the camera 'front'" in str(notes["wide"])
    assert "'narrow' sees 0.53 times" in str(notes["narrow"])
    assert (notes["similar"], notes["unknown"], notes["front"]) == (None, None, None)
    assert "note" not in server.query(posed, jpeg(2))


def test_auto_verifies_for_the_pose(server: Server, posed: str) -> None:
    answer = server.query(posed, jpeg(2), camera="front")
    assert answer["verification"]["state"] == "verified" and answer["pose"]["source"] == "intrinsics"


def test_without_intrinsics_the_heading_has_an_offset_with_a_wider_spread(server: Server, posed: str) -> None:
    known, assumed = (
        server.query(posed, encoded(seen_again(scene(2))), verify="always", **camera)["pose"]
        for camera in ({"camera": "front"}, {})
    )
    assert assumed["source"] == "field-of-view" and assumed["offset_spread"] >= known["offset_spread"]
    places = server.query(posed, jpeg(2), verify="never")["pose"]
    assert places["source"] == "places" and "heading_offset" not in places and len(places["covariance"]) == 36


def test_a_frame_of_another_shape_is_answered_without_the_intrinsics(server: Server, posed: str) -> None:
    pose = server.query(posed, jpeg(2, width=320, height=200), verify="always", camera="front")["pose"]
    if pose is not None:  # the drawn scene of another shape is still recognized
        assert pose["source"] != "intrinsics" and "320 x 240" in pose["note"]


def test_a_pose_says_why_the_intrinsics_were_not_used(server: Server, posed: str) -> None:
    assert "compared" in server.query(posed, jpeg(2), verify="never", camera="front")["pose"]["note"]
    assert "note" not in server.query(posed, jpeg(2), verify="never")["pose"]
    for name, fields, reason in (("no-lens", {"heading": 90}, "camera of the place"), ("no-heading", {}, "no heading")):
        server.create_map(name)
        server.client.put(f"/v1/maps/{name}/cameras/front", json={"intrinsics": INTRINSICS}).raise_for_status()
        camera = {} if fields else {"camera": "front"}
        for seed in range(4):
            server.enrol(name, f"p{seed}", jpeg(seed), x=20 * seed, y=0, **fields, **camera)
        pose = server.query(name, jpeg(2), verify="always", camera="front")["pose"]
        assert pose["source"] != "intrinsics" and "'p2'" in pose["note"] and reason in pose["note"]


@pytest.mark.parametrize(
    ("name", "value"), [("fx", 0.0), ("cx", 1000.0), ("distortion", [0.1, 0.2, 0.3]), ("width", 0), ("fy", -300.0)]
)
def test_impossible_intrinsics_are_refused(server: Server, posed: str, name: str, value: object) -> None:
    response = server.client.put(f"/v1/maps/{posed}/cameras/odd", json={"intrinsics": INTRINSICS | {name: value}})
    assert_problem(response, 422, "invalid-request")
    assert server.client.get(f"/v1/maps/{posed}/cameras/odd").status_code == 404
