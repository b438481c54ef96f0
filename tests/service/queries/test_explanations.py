"""Explanations over HTTP: their parts add up to the score, and their pictures can be fetched."""

from __future__ import annotations

from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


def pair(first: bytes, second: bytes) -> dict[str, Any]:
    return {"a": ("a.jpg", first, "image/jpeg"), "b": ("b.jpg", second, "image/jpeg")}


def parts(explanation: dict[str, Any]) -> float:
    return sum(explanation["words"]) + sum(cell["gain"] for cell in explanation["cells"])


def again(seed: int) -> bytes:
    return encoded(seen_again(scene(seed)))


def test_the_parts_of_two_frames_add_up_to_their_score(client: httpx.Client) -> None:
    answer = client.post("/v1/match", params={"explain": True}, files=pair(jpeg(3), again(3))).json()
    explanation = answer["explanation"]
    assert explanation["score"] == pytest.approx(answer["score"], abs=1e-4)
    assert parts(explanation) == pytest.approx(answer["score"], abs=1e-3)
    rows, columns = explanation["grid"]
    for cell in explanation["cells"]:
        for row, column in (cell["query"], cell["match"]):
            assert 0 <= row < rows and 0 <= column < columns
    losses = [region["loss"] for region in explanation["query_regions"]]
    assert losses == sorted(losses, reverse=True) and losses[0] > 0
    for side in ("query_regions", "match_regions"):
        for region in explanation[side]:
            box = region["box"]
            assert 0 <= box["left"] < box["right"] <= 1 and 0 <= box["top"] < box["bottom"] <= 1
    for answering in explanation["regions"]:
        left = explanation["query_regions"][answering["query"]]
        right = explanation["match_regions"][answering["match"]]
        assert left["word"] == right["word"]


def test_the_cells_of_a_frame_match_themselves(client: httpx.Client) -> None:
    explanation = client.post("/v1/match", params={"explain": True}, files=pair(jpeg(3), jpeg(3))).json()["explanation"]
    assert explanation["cells"] and all(cell["query"] == cell["match"] for cell in explanation["cells"])
    assert explanation["query_regions"] == explanation["match_regions"]


def test_without_explain_there_is_no_explanation(client: httpx.Client) -> None:
    assert "explanation" not in client.post("/v1/match", files=pair(jpeg(3), jpeg(4))).json()


@pytest.mark.parametrize("asked", [{"params": {"format": "png"}}, {"headers": {"Accept": "image/png"}}])
def test_two_frames_are_drawn_side_by_side(client: httpx.Client, asked: dict[str, Any]) -> None:
    drawn = client.post("/v1/match", files=pair(jpeg(3), again(3)), **asked)
    assert drawn.headers["content-type"] == "image/png" and drawn.content.startswith(PNG_MAGIC)
    pixels = cv2.imdecode(np.frombuffer(drawn.content, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None and pixels.shape == (360, 480 + 8 + 480, 3)
    frame = cv2.resize(scene(3), (480, 360), interpolation=cv2.INTER_AREA)
    # Under the lines the left half is the frame.
    same = np.abs(pixels[:, :480].astype(int) - frame).max(axis=2) < 40
    assert 0.5 < same.mean() < 1.0


def test_a_blank_frame_is_explained_too(client: httpx.Client) -> None:
    answer = client.post("/v1/match", params={"explain": True}, files=pair(encoded(blank()), jpeg(3))).json()
    assert answer["score"] == 0 and answer["explanation"]["query_regions"] == []


@pytest.mark.thorough
@pytest.mark.parametrize("keep", ["thumbnail", "image", "none"])
def test_a_query_can_be_explained(server: Server, keep: str) -> None:
    map_id = f"why-{keep}"
    server.create_map(map_id, keep=keep)
    for number in range(6):
        server.enrol(map_id, f"p{number}", jpeg(number))
    answer = server.query(map_id, again(2), explain=True)
    explanation = answer["explanation"]
    assert explanation["place"] == answer["matches"][0]["place"]["id"] == "p2"
    best = answer["matches"][0]
    assert best["parts"]["geometry"] != 0, "a map of so few places leaves doubt, so it was verified"
    assert parts(explanation) == pytest.approx(best["score"] - best["parts"]["geometry"], abs=5e-3)
    assert explanation["match_picture"] == keep
    if keep == "none":
        assert explanation["match_regions"] is None and explanation["picture"] is None
        return
    assert explanation["match_regions"] and explanation["regions"]
    drawn = server.client.get(explanation["picture"])
    assert drawn.status_code == 200 and drawn.content.startswith(PNG_MAGIC)


def test_a_picture_belongs_to_its_map(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p", jpeg(1))
    path = server.query(map_id, again(1), explain=True)["explanation"]["picture"]
    server.create_map("another")
    assert_problem(server.client.get(path.replace(map_id, "another")), 404, "unknown-explanation")
    assert_problem(server.client.get(f"{path}x"), 404, "unknown-explanation")


def test_nothing_is_explained_where_there_is_no_match(server: Server, map_id: str) -> None:
    assert server.query(map_id, jpeg(1), explain=True)["explanation"] is None
    server.enrol(map_id, "p", jpeg(1))
    assert server.query(map_id, encoded(blank()), explain=True)["explanation"] is None
