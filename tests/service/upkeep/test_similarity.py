"""The similarity of two traverses over HTTP: its three forms, its limits, and what it says of the way."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.method.encoder import Encoder
from core.upkeep.similarity import score_pairs
from service.upkeep.alignment import TraversesToAlign
from service.upkeep.similarity import MOST_CACHED, Matrices
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.engines import ENCODER, runtime_at
from tests.service.map_jobs import asked, finished
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem
from tests.service.upkeep.test_alignment import DIMENSION, visit, walk

FRAMES = 12


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with a map of two walks along the same way: monday without its first two frames, tuesday whole."""
    folder = tmp_path_factory.mktemp("similarity")
    install_coarse_encoder(folder / "models")
    server = Server(folder, {"encoder": COARSE, "max_similarity_pairs": 150}).wait()
    server.create_map("lab", same_place_radius=1.0)
    for number in range(FRAMES):
        pose = {"x": 2 * number, "y": 0}
        assert server.enrol("lab", f"t{number}", jpeg(number), sequence="tuesday", **pose).is_success
        if number >= 2:
            again = encoded(seen_again(scene(number)))
            assert server.enrol("lab", f"m{number}", again, sequence="monday", **pose).is_success
    for number in range(2):
        assert server.enrol("lab", f"s{number}", jpeg(100 + number), sequence="short").is_success
    yield server
    assert server.stop() == 0


def similarity(server: Server, query: str = "monday", reference: str = "tuesday") -> dict[str, Any]:
    answer = server.client.get("/v1/maps/lab/similarity", params={"query": query, "reference": reference})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


@pytest.mark.thorough
def test_the_three_forms_are_of_one_matrix(compared: Server) -> None:
    there = "/v1/maps/lab/similarity?query=monday&reference=tuesday"
    about = similarity(compared)
    picture = compared.client.get(there, headers={"Accept": "image/png"})
    raw = compared.client.get(there, headers={"Accept": "application/octet-stream"})
    assert picture.headers["content-type"] == "image/png"
    pixels = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None and pixels.shape == (about["rows"], about["columns"]) == (10, FRAMES)
    assert pixels.dtype == np.uint8 and pixels.tobytes() == raw.content
    for answer in (picture, raw):
        assert (answer.headers["x-rows"], answer.headers["x-columns"]) == ("10", str(FRAMES))
        low, high = float(answer.headers["x-low"]), float(answer.headers["x-high"])
        assert {"low": low, "high": high} == about["scale"] and low < high
    shown = pixels.argmax(axis=1)
    assert [about["reference"]["places"][column] for column in shown] == [f"t{number}" for number in range(2, FRAMES)]
    assert about["query"] == {"sequence": "monday", "places": [f"m{number}" for number in range(2, FRAMES)]}


def test_the_scores_are_those_of_a_query_before_the_second_stage(compared: Server) -> None:
    about = similarity(compared, "tuesday", "monday")
    raw = compared.client.get(
        "/v1/maps/lab/similarity?query=tuesday&reference=monday", headers={"Accept": "application/octet-stream"}
    )
    values = np.frombuffer(raw.content, np.uint8).reshape(about["rows"], about["columns"])
    scale = about["scale"]
    answer = compared.query("lab", jpeg(5), k=100, verify="never")
    parts = {match["place"]["id"]: match["parts"]["similarity"] for match in answer["matches"]}
    for place, value in zip(about["reference"]["places"], values[5], strict=True):
        told = scale["low"] + value / 255 * (scale["high"] - scale["low"])
        assert abs(told - parts[place]) < (scale["high"] - scale["low"]) / 255 + 1e-3, place


def test_the_way_and_the_truth_agree(compared: Server) -> None:
    about = similarity(compared)
    assert about["truth"] == list(range(2, FRAMES)) and about["radius"] == 1.0
    (path,) = about["stretches"]
    assert path["query"] == list(range(10)) and path["reference"] == about["truth"] and path["gain"] > 0
    assert not about["aligned"] and about["counterparts"] is None
    short = similarity(compared, "short")
    assert short["truth"] is None and short["stretches"] == [] and short["rows"] == 2


def test_the_result_of_alignment_is_shown(compared: Server) -> None:
    job = asked(compared, "lab", "align", sequence="monday", **{"with": ["tuesday"]})
    assert finished(compared, job)["state"] == "succeeded"
    about = similarity(compared)
    assert about["aligned"] and about["counterparts"] == about["truth"]


@pytest.mark.thorough
def test_pairs_are_bounded(compared: Server) -> None:
    for number in range(12, 16):
        compared.enrol("lab", f"w{number}", jpeg(number), sequence="wednesday")
    get = compared.client.get
    assert get("/v1/maps/lab/similarity?query=tuesday&reference=wednesday").status_code == 200
    assert get("/v1/maps/lab/similarity?query=tuesday&reference=tuesday").status_code == 200
    for number in range(16, 26):
        compared.enrol("lab", f"w{number}", jpeg(number), sequence="wednesday")
    refused = get("/v1/maps/lab/similarity?query=tuesday&reference=wednesday")
    assert "12 and 14 frames" in assert_problem(refused, 422, "too-many-pairs")["detail"]


def test_bad_requests_are_refused(compared: Server) -> None:
    get = compared.client.get
    assert_problem(get("/v1/maps/lab/similarity?query=monday&reference=nowhere"), 404, "unknown-sequence")
    assert_problem(get("/v1/maps/none/similarity?query=a&reference=b"), 404, "unknown-map")
    for bad in ("", "?query=monday", "?query=monday&reference=", "?query=a&reference=b&more=1", "?query=a&query=b"):
        assert_problem(get(f"/v1/maps/lab/similarity{bad}"), 422, "invalid-request")


class Plain:
    """Scores as they are; a map of random descriptors has no encoder."""

    dimension = 64

    @staticmethod
    def scores_from_inner_products(products: NDArray[np.float32]) -> NDArray[np.float32]:
        return products


@pytest.mark.thorough
def test_the_latest_matrices_are_cached_and_follow_the_traverses(tmp_path: Path) -> None:
    plain = cast(Encoder, Plain())
    with runtime_at(tmp_path) as runtime:
        map_ = runtime.engine.maps.create("lab", ENCODER, DIMENSION)
        ways = walk(count=700)
        visit(map_, "a", ways)
        visit(map_, "b", ways[::2], seed=2)
        matrices, traverses = Matrices(), TraversesToAlign(map_)
        first, second = traverses.frames("a"), traverses.frames("b")
        made = matrices.of(map_, traverses, plain, first, second)
        snapshot = traverses.snapshot
        products = snapshot.descriptors_at(first) @ snapshot.descriptors_at(second).T
        assert np.allclose(made.scores, products, atol=1e-5)
        turned = score_pairs(snapshot, plain, second, first)
        assert np.allclose(turned, products.T, atol=1e-5), "whichever is the longer"
        assert matrices.of(map_, TraversesToAlign(map_), plain, first, second) is made
        map_.forget("a3")
        later = TraversesToAlign(map_)
        other = matrices.of(map_, later, plain, later.frames("a"), second)
        assert other is not made and len(other.scores) == 699
        for count in range(MOST_CACHED + 1):
            matrices.of(map_, later, plain, second[: count + 5], second)
        assert matrices.of(map_, traverses, plain, first, second) is not made
