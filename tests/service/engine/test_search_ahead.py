"""Frames of small maps are searched for in the encoder's thread, with the same answers as other searches."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch

from core.frames.images import Limits
from core.frames.preprocessing import Pixels
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.storage import Map
from service.engine import searches
from service.engine.microbatches import MOST_FRAMES, AfterEncoding, Encoded, MicroBatches, QueuedFrame
from service.engine.searches import Searches, search_ahead
from service.queries.parameters import QueryParameters
from tests.service.engine.test_searches import map_of_scenes
from tests.service.scenes import jpeg, scene, seen_again

pytestmark = pytest.mark.anyio


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


@pytest.fixture(scope="module")
def map_(encoder: Encoder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Map]:
    with map_of_scenes(encoder, tmp_path_factory.mktemp("atlas"), 4) as made:
        yield made


def encoded(encoder: Encoder, pixels: Pixels) -> Encoded:
    return Encoded(pixels, encoder.encode(pixels), encoder, {})


@pytest.mark.parametrize("together", [1, 2, 4])
async def test_a_search_ahead_has_the_answers_of_an_ordinary_search(map_: Map, encoder: Encoder, together: int) -> None:
    search = search_ahead(map_, 3, None)
    assert search is not None and search == search_ahead(map_, 3, None) != search_ahead(map_, 4, None)
    frames = [seen_again(scene(seed), seed) for seed in range(together)]
    shown = [encoded(encoder, frame) for frame in [*frames, scene(0) * 0]]
    *found, blank = search(shown)
    assert blank is None, "a blank frame is like no place"
    assert search(shown[-1:]) == [None]
    for seed, (one, located) in enumerate(zip(shown, found, strict=False)):
        (expected,) = await Searches().locate(map_, encoder, [one.encoding], 3)
        (ahead,) = located or []
        assert ahead.judgement == expected.judgement
        assert [(score, place.id) for score, place in ahead.matches] == [
            (score, place.id) for score, place in expected.matches
        ]
        assert ahead.matches[0][1].id == f"p{seed}"


def test_searches_that_may_take_long_are_not_done_ahead(
    map_: Map, encoder: Encoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert search_ahead(map_, 3, QueryParameters(sequences="monday").selection()) is None
    search, now = search_ahead(map_, 3, None), map_.snapshot()
    assert search is not None
    with monkeypatch.context() as patched:
        patched.setattr(map_, "snapshot", lambda: replace(now, holds=False))
        assert search([encoded(encoder, scene(0))]) == [None], "what is on the disk may take long"
    monkeypatch.setattr(searches, "MOST_AHEAD", 3)
    assert search_ahead(map_, 3, None) is None


# Where frames are encoded


@pytest.fixture
def batches(encoder: Encoder) -> Iterator[MicroBatches]:
    made = MicroBatches(lambda _: encoder, Limits(), lambda _: None)
    made.put([first := QueuedFrame("", jpeg(0), None, time.monotonic() + 60)])
    first.result.result(60)
    yield made
    made.close()


def search_results(batches: MicroBatches, count: int, *callbacks: AfterEncoding) -> list[object]:
    """The search results of ``count`` frames that waited together, which have the callbacks in turn."""
    free = threading.Event()
    batches.call(lambda: free.wait(30))
    kinds = [callbacks[index % len(callbacks)] for index in range(count)]
    frames = [
        QueuedFrame("", jpeg(seed), None, time.monotonic() + 60, after_encoding=callback)
        for seed, callback in enumerate(kinds)
    ]
    batches.put(frames)
    free.set()
    return [frame.result.result(60).search_result for frame in frames]


def test_after_encoding_runs_in_the_encoders_thread(batches: MicroBatches) -> None:
    def callback(together: Sequence[Encoded]) -> list[str]:
        return [threading.current_thread().name for _ in together]

    assert search_results(batches, 1, callback) == ["encoder"]
    names = search_results(batches, 2 * MOST_FRAMES, callback)
    assert None not in names
    if torch.get_num_threads() > 1:
        assert "encoder" not in names, "several frames are taken by threads that have a core each"


def test_frames_with_equal_callbacks_share_a_call(batches: MicroBatches) -> None:
    def one(together: Sequence[Encoded]) -> list[object]:
        return [("one", len(together), encoded.encoding.descriptor.sum()) for encoded in together]

    def other(together: Sequence[Encoded]) -> list[object]:
        return [("other", len(together), encoded.encoding.descriptor.sum()) for encoded in together]

    alone = [search_results(batches, seed + 1, one)[seed][2] for seed in range(4)]  # type: ignore[index]
    found: list[Any] = search_results(batches, 4, one, other)
    assert [name for name, _, _ in found] == ["one", "other", "one", "other"]
    assert sum(1 / count for _, count, _ in found) >= 2, "each callback has its own frames"
    assert [total for _, _, total in found] == pytest.approx(alone, rel=1e-4)


def test_a_single_frame_is_not_searched_for_on_all_cores_while_others_wait(batches: MicroBatches) -> None:
    began, free = threading.Event(), threading.Event()

    def slow(_: str) -> Encoder:
        began.set()
        free.wait(30)
        return load("")

    load, batches._load = batches._load, slow
    frames = [
        QueuedFrame("", jpeg(seed), None, time.monotonic() + 60, after_encoding=lambda many: [1] * len(many))
        for seed in range(2)
    ]
    batches.put(frames[:1])
    assert began.wait(30)
    batches.put(frames[1:])
    free.set()
    found = [frame.result.result(60).search_result for frame in frames]
    assert found == ([None, 1] if torch.get_num_threads() > 1 else [1, 1])


def test_a_callback_may_fail(batches: MicroBatches) -> None:
    def breaks(_: Sequence[Encoded]) -> list[object]:
        raise ArithmeticError

    def too_few(_: Sequence[Encoded]) -> list[object]:
        return []

    for callback in (breaks, too_few):
        for count in (1, 4):
            assert search_results(batches, count, callback) == [None] * count
