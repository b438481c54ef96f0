"""Frames of small maps are searched for in the encoder's thread, with the same answers as other searches."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from core.frames.images import Limits, decode
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.recognition.question import Question
from core.store import Map
from core.threads import allowed_threads
from service.engine import searches
from service.engine.encoder_threads import EncoderThreads
from service.engine.encoders import AfterEncoding, Encoded, QueuedFrame
from service.engine.searches import Searches, search_ahead
from service.queries.parameters import QueryParameters
from tests.service.engine.test_searches import map_of_scenes
from tests.service.scenes import blank, jpeg, scene, seen_again
from tests.service.scenes import encoded as written

pytestmark = pytest.mark.anyio


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


@pytest.fixture(scope="module")
def map_(encoder: Encoder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Map]:
    with map_of_scenes(encoder, tmp_path_factory.mktemp("maps"), 4) as made:
        made.open()
        yield made


def encoded(encoder: Encoder, pixels: Pixels) -> Encoded:
    return Encoded(pixels, encoder.encode(pixels), encoder, {})


@pytest.mark.parametrize("seed", range(3))
async def test_a_search_ahead_has_the_answers_of_an_ordinary_search(map_: Map, encoder: Encoder, seed: int) -> None:
    search = search_ahead(map_, Question(3))
    assert search is not None
    shown = encoded(encoder, seen_again(scene(seed), seed))
    ahead = search(shown)
    (expected,) = await Searches().locate(map_, encoder, [shown.query(Question(3))])
    assert ahead is not None and ahead.judgement == expected.judgement
    assert [(score, place.id) for score, place in ahead.matches] == [
        (score, place.id) for score, place in expected.matches
    ]
    assert ahead.matches[0][1].id == f"p{seed}"
    assert search(encoded(encoder, scene(0) * 0)) is None, "a blank frame is like no place"


def test_searches_that_may_take_long_are_not_done_ahead(
    map_: Map, encoder: Encoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert search_ahead(map_, QueryParameters(sequences="monday").question()) is None
    search = search_ahead(map_, Question(3))
    assert search is not None
    for setting, is_held in (("compact", False), ("auto", True)):
        map_.edit({"index": setting})
        map_.open()
        found = search(encoded(encoder, scene(0)))
        assert (found is not None) == is_held, "what is on the disk may take long"
    monkeypatch.setattr(searches, "MOST_AHEAD", 3)
    assert search_ahead(map_, Question(3)) is None


# Where frames are encoded


@pytest.fixture
def threads() -> Iterator[EncoderThreads]:
    made = EncoderThreads(Limits())
    yield made
    made.close()


def search_results(threads: EncoderThreads, encoder: Encoder, count: int, callback: AfterEncoding) -> list[object]:
    """The search results of ``count`` frames that wait together."""
    frames = [
        QueuedFrame(encoder, jpeg(seed), None, time.monotonic() + 60, after_encoding=callback) for seed in range(count)
    ]
    threads.put(frames)
    return [frame.result.result(60).search_result for frame in frames]


def test_after_encoding_runs_in_the_encoders_threads(threads: EncoderThreads, encoder: Encoder) -> None:
    def callback(encoded: Encoded) -> tuple[str, float]:
        return threading.current_thread().name, encoded.encoding.descriptor.sum()

    found: list[Any] = search_results(threads, encoder, 4, callback)
    assert {name for name, _ in found} <= {f"encoder-{number}" for number in range(allowed_threads())}
    alone = [encoder.encode(decode(jpeg(seed))).descriptor.sum() for seed in range(4)]
    assert [total for _, total in found] == pytest.approx(alone, rel=1e-4)


def test_a_callback_may_fail(threads: EncoderThreads, encoder: Encoder) -> None:
    def breaks(_: Encoded) -> object:
        raise ArithmeticError

    assert search_results(threads, encoder, 3, breaks) == [None] * 3


@pytest.mark.parametrize("count", [1, 3])
def test_keypoints_are_there_for_the_search_and_in_the_result(
    threads: EncoderThreads, encoder: Encoder, count: int
) -> None:
    """Of a frame alone they are found while it is encoded; of several frames when they are wanted."""
    frames = [
        QueuedFrame(
            encoder, jpeg(seed), None, time.monotonic() + 60, keypoints=True, after_encoding=Encoded.find_keypoints
        )
        for seed in range(count)
    ]
    threads.put(frames)
    for seed, frame in enumerate(frames):
        made = frame.result.result(60)
        alone = find_keypoints(packaged_xfeat(), decode(jpeg(seed)))
        assert made.keypoints is not None and made.search_result is made.keypoints is made.find_keypoints()
        np.testing.assert_array_equal(made.keypoints.positions, alone.positions)
        assert made.milliseconds["keypoints"] > 0 and made.without_pixels().keypoints is made.keypoints


def test_a_blank_frame_has_no_keypoints(threads: EncoderThreads, encoder: Encoder) -> None:
    frame = QueuedFrame(encoder, written(blank()), None, time.monotonic() + 60, keypoints=True)
    threads.put([frame])
    made = frame.result.result(60)
    assert made.keypoints is None and "keypoints" not in made.milliseconds
