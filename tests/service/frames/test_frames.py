"""Frames without a map, over HTTP."""

from __future__ import annotations

import base64

import cv2
import httpx
import numpy as np
import pytest

from core.frames.images import decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from tests.service.encoders import COARSE, LAYERS, TWO_STAGES
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import assert_problem

JPEG = {"Content-Type": "image/jpeg"}
OCTETS = {"Accept": "application/octet-stream"}


def test_a_descriptor_is_the_encoders_own(client: httpx.Client) -> None:
    answer = client.post("/v1/encode", content=jpeg(1), headers=JPEG).json()
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    values = np.frombuffer(base64.b64decode(answer["descriptor"]), "<f4")
    expected = encoder.encode(decode(jpeg(1)))
    assert answer["encoder"] == encoder.identity and answer["dimension"] == len(values) == encoder.dimension
    assert answer["regions"] == len(expected.regions)
    assert float(values @ expected.descriptor) / float(expected.descriptor @ expected.descriptor) > 0.9999
    assert (answer["dtype"], answer["byte_order"]) == ("float32", "little")


def test_a_descriptor_as_bytes(client: httpx.Client) -> None:
    raw = client.post("/v1/encode", content=jpeg(1), headers=JPEG | OCTETS)
    assert raw.headers["content-type"] == "application/octet-stream"
    assert raw.headers["x-encoder"].startswith(DEFAULT_ENCODER) and int(raw.headers["x-regions"]) > 0
    text = client.post("/v1/encode", content=jpeg(1), headers=JPEG).json()["descriptor"]
    assert base64.b64decode(text) == raw.content


def test_another_encoder(client: httpx.Client) -> None:
    answer = client.post("/v1/encode", params={"encoder": COARSE}, content=jpeg(1), headers=JPEG).json()
    assert answer["encoder"].startswith(f"{COARSE}@") and answer["dimension"] == 8 * 384
    for path in ("encode", "regions"):
        response = client.post(f"/v1/{path}", params={"encoder": "absent"}, content=jpeg(1), headers=JPEG)
        assert_problem(response, 422, "unknown-encoder")


def test_a_blank_frame_has_no_descriptor(client: httpx.Client) -> None:
    response = client.post("/v1/encode", params={"encoder": COARSE}, content=encoded(blank()), headers=JPEG)
    assert_problem(response, 422, "no-regions")


def test_regions_as_json(client: httpx.Client) -> None:
    answer = client.post("/v1/regions", content=jpeg(1, 640, 480), headers=JPEG).json()
    assert (answer["width"], answer["height"]) == (640, 480)
    assert answer["found"] == len(answer["regions"]) > 0
    layers = {layer["name"]: (layer["rows"], layer["columns"]) for layer in answer["layers"]}
    assert list(layers) == ["conv3", "conv4"]
    for region in answer["regions"]:
        rows, columns = layers[region["layer"]]
        top, left, bottom, right = region["cells"]
        assert 0 <= top < bottom <= rows and 0 <= left < right <= columns and region["energy"] > 0
        box = region["box"]
        assert box["left"] == pytest.approx(left * 640 / columns, abs=0.01)
        assert box["bottom"] == pytest.approx(bottom * 480 / rows, abs=0.01)
    fewer = client.post("/v1/regions", params={"limit": 5}, content=jpeg(1, 640, 480), headers=JPEG).json()
    strongest = sorted((region["energy"] for region in answer["regions"]), reverse=True)[:5]
    assert sorted((region["energy"] for region in fewer["regions"]), reverse=True) == strongest


def test_layers_that_only_the_second_stage_compares_have_no_regions(client: httpx.Client) -> None:
    answer = client.post("/v1/regions", params={"encoder": TWO_STAGES}, content=jpeg(1), headers=JPEG).json()
    assert answer["found"] > 0
    assert [layer["name"] for layer in answer["layers"]] == list(LAYERS)
    assert {region["layer"] for region in answer["regions"]} <= set(LAYERS)


def test_regions_drawn(client: httpx.Client) -> None:
    by_parameter = client.post("/v1/regions", params={"format": "png"}, content=jpeg(1), headers=JPEG)
    by_header = client.post("/v1/regions", content=jpeg(1), headers=JPEG | {"Accept": "image/png"})
    assert by_parameter.content == by_header.content
    assert by_parameter.headers["content-type"] == "image/png"
    drawn = cv2.imdecode(np.frombuffer(by_parameter.content, np.uint8), cv2.IMREAD_COLOR)
    assert drawn is not None and drawn.shape == (240, 320, 3)
    changed = np.abs(drawn.astype(int) - decode(jpeg(1)).astype(int)).max(axis=2) > 40
    assert 0.001 < changed.mean() < 0.5, "rectangles, not another picture"
    large = client.post("/v1/regions", params={"format": "png"}, content=jpeg(1, 1600, 1200), headers=JPEG)
    shrunk = cv2.imdecode(np.frombuffer(large.content, np.uint8), cv2.IMREAD_COLOR)
    assert shrunk is not None and shrunk.shape == (960, 1280, 3)


def test_regions_of_a_blank_frame_are_none(client: httpx.Client) -> None:
    answer = client.post("/v1/regions", params={"encoder": COARSE}, content=encoded(blank()), headers=JPEG).json()
    assert answer["found"] == 0 and answer["regions"] == []
    parameters = {"encoder": COARSE, "format": "png"}
    drawn = client.post("/v1/regions", params=parameters, content=encoded(blank()), headers=JPEG)
    assert drawn.status_code == 200


@pytest.mark.parametrize("parameters", [{"format": "gif"}, {"limit": 0}, {"limit": -3}, {"layer": "conv3"}])
def test_bad_region_parameters(client: httpx.Client, parameters: dict[str, str]) -> None:
    assert_problem(client.post("/v1/regions", params=parameters, content=jpeg(1), headers=JPEG), 422, "invalid-request")


def score(client: httpx.Client, a: bytes, b: bytes, **data: str) -> httpx.Response:
    return client.post("/v1/match", data=data, files={"a": ("a", a, "image/jpeg"), "b": ("b", b, "image/jpeg")})


def test_the_score_of_two_frames(client: httpx.Client) -> None:
    itself = score(client, jpeg(1), jpeg(1)).json()
    again = score(client, jpeg(1), encoded(seen_again(scene(1)))).json()
    other = score(client, jpeg(1), jpeg(2)).json()
    assert itself["score"] > again["score"] > other["score"]
    assert score(client, jpeg(2), jpeg(1)).json()["score"] == pytest.approx(other["score"], abs=1e-6)
    assert itself["encoder"].startswith(DEFAULT_ENCODER) and set(itself["regions"]) == {"a", "b"}


def test_a_blank_frame_scores_nothing(client: httpx.Client) -> None:
    answer = score(client, jpeg(1), encoded(blank()), encoder=COARSE).json()
    assert answer["score"] == 0 and answer["regions"]["b"] == 0 < answer["regions"]["a"]


def test_match_needs_its_two_parts(client: httpx.Client) -> None:
    files = {"a": ("a", jpeg(1), "image/jpeg")}
    assert_problem(client.post("/v1/match", files=files), 422, "invalid-request")
    three = {name: (name, jpeg(1), "image/jpeg") for name in "abc"}
    assert_problem(client.post("/v1/match", files=three), 422, "invalid-request")
    assert_problem(client.post("/v1/match", content=jpeg(1), headers=JPEG), 415, "unsupported-media-type")
    assert_problem(score(client, jpeg(1), b"no image"), 422, "not-an-image")
    assert_problem(score(client, jpeg(1), jpeg(1)[:500]), 422, "truncated-image")
    assert_problem(score(client, jpeg(1), jpeg(2), encoder="absent"), 422, "unknown-encoder")
