"""Queries that arrive at the same time share a search, and have the same answers as alone."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from core.errors import StorageFailure
from core.maps import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import PlaceFields
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, locate
from core.store import Directory, Map
from service.engine import searches
from service.engine.searches import MOST_TOGETHER, Searches
from tests.service.scenes import scene, seen_again

pytestmark = pytest.mark.anyio


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    catalogue = EncoderCatalogue()
    return catalogue.get(catalogue.resolve(DEFAULT_ENCODER))


@pytest.fixture(scope="module")
def queries(encoder: Encoder) -> list[Encoding]:
    return encoder.encode_batch([seen_again(scene(seed), seed) for seed in range(6)])


@pytest.fixture(scope="module")
def map_(encoder: Encoder, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Map]:
    with map_of_scenes(encoder, tmp_path_factory.mktemp("atlas"), 6) as made:
        yield made


@contextmanager
def map_of_scenes(encoder: Encoder, folder: Path, count: int) -> Iterator[Map]:
    """So many scenes as the places p0, p1, …"""
    atlas = Directory(folder / "data")
    made = atlas.create("lab", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    encodings = encoder.encode_batch([scene(seed) for seed in range(count)])
    made.enrol([enrolment(seed, encoding) for seed, encoding in enumerate(encodings)])
    yield made
    atlas.close()


def enrolment(seed: int, encoding: Encoding) -> Enrolment:
    return Enrolment(
        id=f"p{seed}",
        fields=PlaceFields(sequence="monday"),
        descriptor=encoding.descriptor,
        local=encoding.local,
        regions=len(encoding.regions),
        digest=bytes([seed]) * 32,
        thumbnail=None,
        image=None,
    )


@pytest.fixture
def sizes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many queries each search was for."""
    noted: list[int] = []

    def noting(map_: Map, encoder: Encoder, queries: Sequence[Query]) -> list[Answer]:
        noted.append(len(queries))
        return locate(map_, encoder, queries)

    monkeypatch.setattr(searches, "locate", noting)
    return noted


def asking(encodings: Sequence[Encoding], k: int) -> list[Query]:
    return [Query(encoding, Question(k)) for encoding in encodings]


def ids(located: Answer) -> list[str]:
    return [place.id for _, place in located.matches]


async def test_searches_together_answer_as_alone(
    map_: Map, encoder: Encoder, queries: list[Encoding], sizes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searches, "cores", lambda: 1)
    together = Searches()
    found = await asyncio.gather(*(together.locate(map_, encoder, asking([query], 3)) for query in queries))
    assert sizes == [len(queries)], "all that came in one moment were one search"
    for query, (one,) in zip(queries, found, strict=True):
        (alone,) = locate(map_, encoder, asking([query], 3))
        assert ids(one) == ids(alone)
        assert one.judgement.verdict == alone.judgement.verdict
        np.testing.assert_allclose(
            [score for score, _ in one.matches], [score for score, _ in alone.matches], rtol=0, atol=1e-5
        )
    assert not together._waiting and not together._running


async def test_queries_that_arrive_during_a_search_share_the_next_one(
    map_: Map, encoder: Encoder, queries: list[Encoding], sizes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searches, "cores", lambda: 1)
    together = Searches()
    first = asyncio.ensure_future(together.locate(map_, encoder, asking(queries[:1], 3)))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    later = [asyncio.ensure_future(together.locate(map_, encoder, asking([query], 3))) for query in queries[1:5]]
    await asyncio.gather(first, *later)
    assert sizes == [1, 4]


async def test_queries_of_a_small_map_are_shared_out_among_the_cores(
    map_: Map, encoder: Encoder, queries: list[Encoding], sizes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searches, "cores", lambda: 2)
    together = Searches()
    await together.locate(map_, encoder, asking(queries[:1], 3))  # by which it learns how small the map is
    found = await asyncio.gather(*(together.locate(map_, encoder, asking([query], 3)) for query in queries[:4]))
    assert max(sizes) == 2 and sum(sizes) == 5
    assert [ids(one)[0] for (one,) in found] == ["p0", "p1", "p2", "p3"]
    sizes.clear()
    monkeypatch.setattr(searches, "MOST_AHEAD", 3)
    await asyncio.gather(*(together.locate(map_, encoder, asking([query], 3)) for query in queries[:4]))
    assert sizes == [4]


async def test_queries_for_different_k_are_searched_together(
    map_: Map, encoder: Encoder, queries: list[Encoding], sizes: list[int]
) -> None:
    together = Searches()
    three, two = await asyncio.gather(
        together.locate(map_, encoder, asking(queries[:2], 3)), together.locate(map_, encoder, asking(queries[2:4], 2))
    )
    assert [len(one.matches) for one in three] == [3, 3] and [len(one.matches) for one in two] == [2, 2]
    assert [ids(one)[0] for one in [*three, *two]] == ["p0", "p1", "p2", "p3"]
    assert sum(sizes) == 4


async def test_a_large_batch_is_several_searches_with_answers_in_order(
    map_: Map, encoder: Encoder, queries: list[Encoding], sizes: list[int]
) -> None:
    many = [queries[index % len(queries)] for index in range(2 * MOST_TOGETHER + 3)]
    found = await Searches().locate(map_, encoder, asking(many, 1))
    assert [ids(one) for one in found] == [[f"p{index % len(queries)}"] for index in range(len(many))]
    assert max(sizes) <= MOST_TOGETHER


async def test_a_failing_query_fails_alone(
    map_: Map, encoder: Encoder, queries: list[Encoding], monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(map_: Map, encoder: Encoder, asked: Sequence[Query]) -> list[Answer]:
        if any(query.encoding is queries[1] for query in asked):
            raise StorageFailure("the disk cannot be read")
        return locate(map_, encoder, asked)

    monkeypatch.setattr(searches, "locate", failing)
    together = Searches()
    found = await asyncio.gather(
        *(together.locate(map_, encoder, asking([query], 1)) for query in queries[:3]), return_exceptions=True
    )
    assert isinstance(found[1], StorageFailure)
    assert [ids(found[index][0]) for index in (0, 2)] == [["p0"], ["p2"]]  # type: ignore[index]
    (after,) = await together.locate(map_, encoder, asking(queries[3:4], 1))
    assert ids(after) == ["p3"]


async def test_a_cancelled_query_does_not_delay_others(map_: Map, encoder: Encoder, queries: list[Encoding]) -> None:
    together = Searches()
    given_up = asyncio.ensure_future(together.locate(map_, encoder, asking(queries[:1], 1)))
    other = asyncio.ensure_future(together.locate(map_, encoder, asking(queries[1:2], 1)))
    await asyncio.sleep(0)
    given_up.cancel()
    (found,) = await other
    assert ids(found) == ["p1"]
    with pytest.raises(asyncio.CancelledError):
        await given_up
