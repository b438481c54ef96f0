"""A frame that comes alone is searched for where it was encoded, and found as it is by the searches of all."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest

from core.encoder import Encoder
from core.encoders import DEFAULT_ENCODER, EncoderCatalogue
from core.images import Limits
from core.preprocessing import Pixels
from core.storage import Map
from service import answers, microbatches
from service.answers import search_ahead
from service.inference import Encoded
from service.microbatches import MicroBatches, Turn
from service.questions import QueryParameters
from service.searches import Searches
from tests.service.scenes import jpeg, scene, seen_again
from tests.service.test_searches import map_of_scenes

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


async def test_searched_ahead_as_searched_for(map_: Map, encoder: Encoder) -> None:
    search = search_ahead(map_, 3, None)
    assert search is not None
    for seed in range(2):
        one = encoded(encoder, seen_again(scene(seed), seed))
        (expected,) = await Searches().locate(map_, encoder, [one.encoding], 3)
        (found,) = search(one) or []
        assert found.judgement == expected.judgement
        assert [(score, place.id) for score, place in found.matches] == [
            (score, place.id) for score, place in expected.matches
        ]
        assert found.matches[0][1].id == f"p{seed}"
    assert search(encoded(encoder, scene(0) * 0)) is None, "a blank frame is like no place"


def test_what_may_take_long_is_not(map_: Map, encoder: Encoder, monkeypatch: pytest.MonkeyPatch) -> None:
    assert search_ahead(map_, 3, QueryParameters(sequences="monday").selection()) is None
    search, now = search_ahead(map_, 3, None), map_.snapshot()
    assert search is not None
    with monkeypatch.context() as patched:
        patched.setattr(map_, "snapshot", lambda: replace(now, holds=False))
        assert search(encoded(encoder, scene(0))) is None, "what is on the disk may take long"
    monkeypatch.setattr(answers, "MOST_AHEAD", 3)
    assert search_ahead(map_, 3, None) is None


# In the encoder's thread


@pytest.fixture
def batches(encoder: Encoder) -> Iterator[MicroBatches]:
    made = MicroBatches(lambda _: encoder, Limits(), lambda _: None)
    yield made
    made.close()


def followed(batches: MicroBatches, count: int, then: Callable[[Encoded], object]) -> list[object]:
    """What came after the encoding of frames that waited together."""
    free = threading.Event()
    batches.call(lambda: free.wait(30))
    turns = [Turn("", jpeg(seed), None, time.monotonic() + 60, then=then) for seed in range(count)]
    batches.put(turns)
    free.set()
    return [turn.result.result(60).followed for turn in turns]


def test_what_comes_next_is_done_where_nobody_waits(batches: MicroBatches, monkeypatch: pytest.MonkeyPatch) -> None:
    def then(_: Encoded) -> str:
        return threading.current_thread().name

    assert followed(batches, 1, then) == ["encoder"]
    assert followed(batches, 2, then) == [None, None], "encoded together, they are searched for together"
    monkeypatch.setattr(microbatches, "MOST_FRAMES", 1)
    assert followed(batches, 2, then) == [None, "encoder"], "the second one waited for the encoder"


def test_what_comes_next_may_fail(batches: MicroBatches) -> None:
    def breaks(_: Encoded) -> None:
        raise ArithmeticError

    assert followed(batches, 1, breaks) == [None]
