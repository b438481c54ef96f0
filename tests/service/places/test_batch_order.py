"""The order of batches: each is encoded and stored after the batch that it names, or not at all."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Sequence

import httpx
import pytest

from service.engine.queue import RequestDeadline
from service.errors.faults import BatchOutOfOrder, ClientGone
from service.places import batch_order
from service.places.batch_order import BatchOrder, BatchTurn, Stage
from tests.service.places.test_batches import send
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem

SMALL = [jpeg(seed, 96, 72) for seed in range(24)]


def deadline(seconds: float = 20.0, gone: asyncio.Event | None = None) -> RequestDeadline:
    async def hung_up() -> None:
        await (gone or asyncio.Event()).wait()

    return RequestDeadline(time.monotonic() + seconds, hung_up)


async def begun(waiting: asyncio.Task[None]) -> None:
    await asyncio.sleep(0.02)
    assert not waiting.done()


@pytest.mark.anyio
async def test_a_batch_waits_for_the_stage_of_the_batch_before() -> None:
    line = BatchOrder()
    with line.enter("lab", "b", "a", deadline()) as second:
        encoding = asyncio.ensure_future(second.wait_for(Stage.ENCODED))
        storing = asyncio.ensure_future(second.wait_for(Stage.STORED))
        with line.enter("lab", "a", None, deadline()) as first, line.enter("hall", "a", None, deadline()) as elsewhere:
            await begun(encoding)
            elsewhere.report(Stage.ENCODED)
            await begun(encoding)
            first.report(Stage.ENCODED)
            await asyncio.wait_for(encoding, 30)
            await begun(storing)
        await asyncio.wait_for(storing, 30)
    with line.enter("lab", None, "b", deadline()) as third:
        await asyncio.wait_for(third.wait_for(Stage.STORED), 30)


@pytest.mark.anyio
async def test_a_failed_batch_is_not_stored_and_may_be_sent_again() -> None:
    line = BatchOrder()
    second = BatchTurn(line, "lab", None, "a", deadline())
    with pytest.raises(ValueError), line.enter("lab", "a", None, deadline()):
        raise ValueError
    storing = asyncio.ensure_future(second.wait_for(Stage.STORED))
    await begun(storing)
    with line.enter("lab", "a", None, deadline()):
        await begun(storing)
    await asyncio.wait_for(storing, 30)
    # What was stored stays so, whatever becomes of a request that says the same again.
    with pytest.raises(ValueError), line.enter("lab", "a", None, deadline()):
        raise ValueError
    await asyncio.wait_for(second.wait_for(Stage.STORED), 30)


@pytest.mark.anyio
async def test_no_batch_waits_forever(monkeypatch: pytest.MonkeyPatch) -> None:
    line = BatchOrder()
    with line.enter("lab", "slow", None, deadline()):
        with pytest.raises(BatchOutOfOrder):
            await BatchTurn(line, "lab", None, "slow", deadline(0.05)).wait_for(Stage.STORED)
        gone = asyncio.Event()
        storing = asyncio.ensure_future(BatchTurn(line, "lab", None, "slow", deadline(20, gone)).wait_for(Stage.STORED))
        await begun(storing)
        gone.set()
        with pytest.raises(ClientGone):
            await asyncio.wait_for(storing, 30)
    monkeypatch.setattr(batch_order, "GRACE", 0.05)
    with pytest.raises(BatchOutOfOrder):
        await asyncio.wait_for(BatchTurn(line, "lab", None, "never", deadline()).wait_for(Stage.ENCODED), 30)


@pytest.mark.anyio
async def test_the_number_of_remembered_names_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_order, "MOST_NAMES", 3)
    line = BatchOrder()
    with line.enter("lab", "open", None, deadline()):
        for number in range(9):
            with line.enter("lab", str(number), None, deadline()):
                pass
        assert [number for number in range(9) if line.stage("lab", str(number)) is not None] == [6, 7, 8]
        assert line.stage("lab", "open") == Stage.BEGUN


def numbered(first: int, count: int) -> list[dict[str, object]]:
    return [{"id": f"p{number}", "file": f"f{number}", "sequence": "walk"} for number in range(first, first + count)]


def files(first: int, count: int) -> dict[str, bytes]:
    return {f"f{number}": SMALL[number] for number in range(first, first + count)}


@pytest.mark.thorough
def test_batches_are_stored_in_order_however_they_arrive(server: Server, map_id: str) -> None:
    answers: dict[str, httpx.Response] = {}

    def post(batch: str, after: str | None, first: int) -> None:
        line = {"batch": batch} if after is None else {"batch": batch, "after": after}
        answers[batch] = send(server, map_id, numbered(first, 8), files(first, 8), params=line)

    senders: Sequence[threading.Thread] = [
        threading.Thread(target=post, args=("c", "b", 16)),
        threading.Thread(target=post, args=("b", "a", 8)),
        threading.Thread(target=post, args=("a", None, 0)),
    ]
    for sender in senders:
        sender.start()
        time.sleep(0.3)
    for sender in senders:
        sender.join(60)
    assert {name: answer.status_code for name, answer in answers.items()} == {"a": 200, "b": 200, "c": 200}
    assert list(server.places(map_id)) == [f"p{number}" for number in range(24)]


@pytest.mark.thorough
def test_no_batch_is_stored_out_of_order(server: Server, map_id: str) -> None:
    def post(first: int, line: dict[str, str], **options: object) -> httpx.Response:
        return send(server, map_id, numbered(first, 2), files(first, 2), params=line, **options)

    hasty = {"X-Request-Timeout": "0.6"}
    assert_problem(post(2, {"after": "a"}, headers=hasty), 409, "batch-out-of-order")
    assert_problem(post(0, {"batch": "a", "encoder": "another"}), 409, "wrong-encoder")
    assert_problem(post(2, {"after": "a"}, headers=hasty), 409, "batch-out-of-order")
    assert list(server.places(map_id)) == []
    # A frame that is bad fails alone: the batch as such is stored.
    places = [*numbered(0, 1), {"id": "bad", "file": "bad"}]
    first = send(server, map_id, places, {"f0": SMALL[0], "bad": b"none"}, params={"batch": "a"})
    assert [item["status"] for item in first.json()["items"]] == [201, 422]
    assert post(2, {"batch": "b", "after": "a"}).status_code == 200
    assert list(server.places(map_id)) == ["p0", "p2", "p3"]
    # Sent once more, as after an answer that was lost, it changes nothing.
    again = post(2, {"batch": "b", "after": "a"})
    assert [item["change"] for item in again.json()["items"]] == ["unchanged", "unchanged"]


@pytest.mark.parametrize(
    "line", [{"batch": "a", "after": "a"}, {"batch": ""}, {"after": "a b"}, {"batch": "a" * 65}, {"after": "a/b"}]
)
def test_invalid_names_of_batches(server: Server, map_id: str, line: dict[str, str]) -> None:
    assert_problem(send(server, map_id, numbered(0, 1), files(0, 1), params=line), 422, "invalid-request")


def test_named_batches_are_refused_in_the_background(server: Server, map_id: str) -> None:
    line = {"background": "true", "batch": "a"}
    assert_problem(send(server, map_id, numbered(0, 1), files(0, 1), params=line), 422, "invalid-request")
