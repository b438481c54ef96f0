"""Queries over HTTP, and their verdicts."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from core.frames.images import Limits, decode
from core.method.catalogue import EncoderCatalogue
from tests.service.encoders import COARSE, SECOND_STAGE, TWO_STAGES
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again, stranger
from tests.service.server import Server, assert_problem


def test_a_place_seen_again_is_recognized(server: Server, traverse: str) -> None:
    for number in (0, 3, 7):
        answer = server.query(traverse, encoded(seen_again(scene(number))))
        assert answer["verdict"] == "recognized" and answer["reason"] is None
        assert answer["place"] == answer["matches"][0]["place"]
        assert answer["place"]["id"] == f"p{number}" and answer["place"]["pose"] == {"x": 2.0 * number, "y": 0.0}
        assert answer["score"] == answer["matches"][0]["score"]
        assert answer["decision"] >= answer["threshold"]
        assert [match["rank"] for match in answer["matches"]] == [1, 2, 3, 4, 5]
        scores = [match["score"] for match in answer["matches"]]
        assert scores == sorted(scores, reverse=True)
        assert answer["encoder"].startswith("m-region-vlad@")
        times = answer["milliseconds"]
        assert {"decode", "forward", "regions", "vlad", "search", "total"} <= set(times)
        assert all(value >= 0 for value in times.values())
        parts = ("decode", "forward", "regions", "vlad", "search")
        assert times["total"] >= sum(times[part] for part in parts)


def test_the_margin_is_over_the_best_rival(server: Server, traverse: str) -> None:
    answer = server.query(traverse, jpeg(3), k=100)
    best = answer["matches"][0]["place"]["pose"]["x"]
    rivals = [match["score"] for match in answer["matches"] if abs(match["place"]["pose"]["x"] - best) > 5]
    assert answer["margin"] == pytest.approx(answer["score"] - max(rivals))


def test_a_place_that_was_never_enrolled_is_unknown(server: Server, traverse: str) -> None:
    verdicts = []
    for seed in range(100, 110):
        answer = server.query(traverse, encoded(stranger(seed)))
        verdicts.append(answer["verdict"])
        if answer["verdict"] != "recognized":
            assert answer["place"] is None
        assert len(answer["matches"]) == 5
    assert verdicts.count("recognized") <= 3


@pytest.mark.thorough
def test_two_similar_places_are_ambiguous(server: Server, map_id: str) -> None:
    server.enrol(map_id, "here", jpeg(1), x=0, y=0)
    server.enrol(map_id, "there", jpeg(1), x=500, y=0)
    for number in range(10, 16):
        server.enrol(map_id, f"p{number}", jpeg(number), x=100 * number, y=0)
    answer = server.query(map_id, encoded(seen_again(scene(1))))
    assert answer["verdict"] == "ambiguous" and answer["place"] is None
    assert {match["place"]["id"] for match in answer["matches"][:2]} == {"here", "there"}
    near = server.client.patch(f"/v1/maps/{map_id}/places/there", json={"pose": {"x": 3}})
    assert near.status_code == 200
    assert server.query(map_id, encoded(seen_again(scene(1))))["verdict"] == "recognized", "no rivals, one place"


def test_the_maps_own_calibration_decides(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p", jpeg(1), x=0, y=0)
    assert server.query(map_id, jpeg(1))["verdict"] == "recognized"
    server.client.patch(f"/v1/maps/{map_id}", json={"calibration": {"threshold": 1}})
    answer = server.query(map_id, jpeg(1))
    assert (answer["verdict"], answer["threshold"]) == ("unknown", 1)


def test_an_empty_map(server: Server, map_id: str) -> None:
    answer = server.query(map_id, jpeg(1))
    assert answer["verdict"] == "unknown" and answer["reason"] == "empty-map"
    assert [answer[name] for name in ("place", "score", "margin", "decision")] == [None] * 4
    assert answer["matches"] == []


def test_a_frame_without_regions(server: Server) -> None:
    server.create_map("coarse-queries", encoder=COARSE)
    server.enrol("coarse-queries", "p", jpeg(1))
    answer = server.query("coarse-queries", encoded(blank()))
    assert (answer["verdict"], answer["reason"], answer["score"]) == ("unknown", "no-regions", None)
    assert answer["place"] is None and answer["matches"] == []
    assert server.query("coarse-queries", jpeg(1))["score"] == pytest.approx(1, abs=1e-5)


@pytest.mark.thorough
def test_the_best_places_are_examined_by_the_second_stage(server: Server) -> None:
    frames = {f"p{seed}": jpeg(seed) for seed in range(20, 26)}
    server.create_map("two-stages", encoder=TWO_STAGES)
    for place_id, data in frames.items():
        assert server.enrol("two-stages", place_id, data, sequence="walk").status_code == 201
    question = encoded(seen_again(scene(22)))
    answer = server.query("two-stages", question, k=100)

    encoder = EncoderCatalogue(server.folder / "models").get(TWO_STAGES)
    limits = Limits(max_bytes=1 << 20, max_pixels=1 << 20, min_side=1)
    query = encoder.encode(decode(question, limits))
    places = {place_id: encoder.encode(decode(data, limits)) for place_id, data in frames.items()}
    rest = 1 - SECOND_STAGE.share
    scores = {place_id: rest * float(place.descriptor @ query.descriptor) for place_id, place in places.items()}
    for place_id in sorted(scores, key=lambda name: -scores[name])[: SECOND_STAGE.candidates]:
        scores[place_id] += float(encoder.agreement(query.local, places[place_id].local[np.newaxis])[0])
    expected = sorted(scores, key=lambda name: -scores[name])
    assert expected[0] == "p22"
    assert [match["place"]["id"] for match in answer["matches"]] == expected
    for match in answer["matches"]:
        assert match["score"] == pytest.approx(scores[match["place"]["id"]], abs=0.01)
    assert answer["score"] > rest, "that from the descriptors, at most, and something from where things are"


@pytest.mark.parametrize("k", [1, 3, 8, 100])
def test_how_many_matches(server: Server, traverse: str, k: int) -> None:
    assert len(server.query(traverse, jpeg(1), k=k)["matches"]) == min(k, 8)


@pytest.mark.parametrize("parameters", [{"k": 0}, {"k": 101}, {"k": "all"}, {"k": 1.5}, {"top": 3}, {"k": "\x00"}])
def test_bad_parameters(server: Server, traverse: str, parameters: dict[str, str]) -> None:
    response = server.client.post(
        f"/v1/maps/{traverse}/query", params=parameters, content=jpeg(1), headers={"Content-Type": "image/jpeg"}
    )
    assert_problem(response, 422, "invalid-request")


def test_an_unknown_map(server: Server) -> None:
    response = server.client.post("/v1/maps/nowhere/query", content=jpeg(1), headers={"Content-Type": "image/jpeg"})
    assert_problem(response, 404, "unknown-map")


def test_a_wrong_encoder(server: Server, traverse: str) -> None:
    path, headers = f"/v1/maps/{traverse}/query", {"Content-Type": "image/jpeg"}
    wrong = server.client.post(path, params={"encoder": COARSE}, content=jpeg(1), headers=headers)
    assert_problem(wrong, 409, "wrong-encoder")
    files = {"image": ("f.jpg", jpeg(1), "image/jpeg")}
    assert_problem(server.client.post(path, data={"encoder": COARSE}, files=files), 409, "wrong-encoder")


def test_a_form_gives_the_same_answer(server: Server, traverse: str) -> None:
    raw = server.query(traverse, jpeg(2), k=3)
    files = {"image": ("f.jpg", jpeg(2), "image/jpeg")}
    form = server.client.post(f"/v1/maps/{traverse}/query", data={"k": "3"}, files=files).json()
    for name in ("verdict", "score", "margin", "place", "matches"):
        assert form[name] == raw[name]


def test_one_map_does_not_answer_for_another(server: Server, map_id: str, traverse: str) -> None:
    server.enrol(map_id, "other", jpeg(50))
    assert [match["place"]["id"] for match in server.query(map_id, jpeg(1), k=100)["matches"]] == ["other"]


@pytest.mark.thorough
def test_queries_while_places_come_and_go(server: Server, map_id: str) -> None:
    for number in range(4):
        server.enrol(map_id, f"stay{number}", jpeg(number))
    frames = [jpeg(number) for number in range(60, 64)]

    def churn(index: int) -> set[int]:
        statuses = set()
        for _ in range(4):
            statuses.add(server.enrol(map_id, f"go{index}", frames[index]).status_code)
            statuses.add(server.client.delete(f"/v1/maps/{map_id}/places/go{index}").status_code)
        return statuses

    def look(index: int) -> bool:
        best = [server.query(map_id, jpeg(index), k=8)["matches"][0]["place"]["id"] for _ in range(6)]
        return set(best) == {f"stay{index}"}

    with ThreadPoolExecutor(8) as pool:
        churned = [pool.submit(churn, index) for index in range(4)]
        looked = [pool.submit(look, index) for index in range(4)]
        assert all(job.result() == {201, 204} for job in churned)
        assert all(job.result() for job in looked)
    assert len(server.query(map_id, jpeg(0), k=100)["matches"]) == 4
