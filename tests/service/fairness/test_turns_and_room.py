"""Turns go to the caller that was served least; the caller that holds most of a room gives way."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from service.fairness import (
    MOST_REMEMBERED,
    REFUSAL_SECONDS,
    REFUSALS_A_SECOND,
    FairQueue,
    Holding,
    RefusalPace,
    SharedRoom,
)


def served(queue: FairQueue[str], costs: dict[str, float], turns: int) -> list[str]:
    """The callers of the next items; each item is named after its caller."""
    order = []
    for _ in range(turns):
        order.append(queue.pop())
        queue.charge(order[-1], costs.get(order[-1], 1.0))
    return order


def filled(**counts: int) -> FairQueue[str]:
    queue = FairQueue[str]()
    for caller, count in counts.items():
        for _ in range(count):
            queue.add(caller, caller)
    return queue


def test_the_items_of_one_caller_stay_in_their_order() -> None:
    queue = FairQueue[int]()
    for number in range(5):
        queue.add("robot", number)
    assert queue.first() == 0 and len(queue) == 5 and [*queue] == [0, 1, 2, 3, 4]
    assert [queue.pop() for _ in range(5)] == [0, 1, 2, 3, 4]
    assert queue.first() is None and not queue
    with pytest.raises(KeyError):
        queue.pop()


def test_a_caller_waits_for_one_item_of_another_at_most() -> None:
    queue = filled(greedy=64)
    assert served(queue, {}, 10) == ["greedy"] * 10
    for _ in range(5):
        queue.add("robot", "robot")
    order = served(queue, {}, 10)
    assert order.count("robot") == 5 and "robot" in order[:2]
    assert all(pair != ("greedy", "greedy") for pair in pairwise(order[order.index("robot") :]))


def test_turns_are_shared_by_their_cost() -> None:
    queue = filled(greedy=100, robot=100)
    order = Counter(served(queue, {"greedy": 20.0, "robot": 1.0}, 105))
    assert order["greedy"] == 5 and order["robot"] == 100


def test_what_was_really_spent_is_counted() -> None:
    queue = filled(greedy=3, robot=12)
    assert queue.pop() == "greedy"
    queue.charge("greedy", 1.0)
    queue.charge("greedy", 9.0)  # it took ten times as long as expected
    assert served(queue, {}, 10) == ["robot"] * 10


def test_nobody_saves_turns_by_being_idle_and_no_debt_is_lost_by_it() -> None:
    queue = filled(busy=10)
    served(queue, {}, 9)
    queue.add("late", "late")
    queue.add("late", "late")
    queue.add("busy", "busy")
    assert sorted(served(queue, {}, 2)) == ["busy", "late"], "not two in a row for the time when it was away"
    queue = filled(expensive=1, robot=4)
    assert served(queue, {"expensive": 3.0}, 1) == ["expensive"]
    queue.add("expensive", "expensive")  # it was away for a moment
    assert served(queue, {}, 5) == ["robot"] * 4 + ["expensive"]


def test_turns_without_waiting_are_no_debt() -> None:
    queue = FairQueue[str]()
    for _ in range(1000):
        queue.pass_by("alone")
        queue.charge("alone", 1.0)
    queue.add("robot", "robot")
    queue.add("robot", "robot")
    queue.add("alone", "alone")
    assert "alone" in served(queue, {}, 3)[:3] and len(queue) == 0
    queue.add("robot", "robot")
    queue.add("robot", "robot")
    queue.add("alone", "alone")
    assert served(queue, {}, 2).count("alone") == 1, "it owes one turn at most"


def test_callers_are_forgotten() -> None:
    queue = FairQueue[str]()
    for number in range(10 * MOST_REMEMBERED):
        queue.add(str(number), str(number))
        served(queue, {}, 1)
    assert len(queue._served) <= MOST_REMEMBERED + 1


def take(room: SharedRoom, caller: str, gone: list[str], share: str | None = None, size: int = 1) -> Holding | None:
    """Take room for a caller; its name is added to ``gone`` when it gives way."""

    def give_way() -> bool:
        gone.append(caller if share is None else f"{caller} {share}")
        return True

    holding = Holding(give_way, share, caller)
    return holding if room.take(holding, size) else None


def test_one_caller_alone_may_use_all_of_a_room() -> None:
    room, gone = SharedRoom(4), list[str]()
    for _ in range(4):
        assert room.has_room(caller="greedy") and take(room, "greedy", gone)
    assert not room.has_room(caller="greedy") and take(room, "greedy", gone) is None
    assert room.held == 4 and not gone


def test_the_greediest_gives_way_until_the_others_have_as_much() -> None:
    room, gone = SharedRoom(4), list[str]()
    for _ in range(4):
        take(room, "greedy", gone)
    assert take(room, "robot", gone) and take(room, "robot", gone)
    assert gone == ["greedy", "greedy"] and room.held == 4
    assert take(room, "robot", gone) is None and take(room, "greedy", gone) is None
    assert take(room, "third", gone) and len(gone) == 3
    assert take(room, "fourth", gone) and take(room, "fifth", gone) is None


def test_of_one_callers_shares_the_largest_gives_way() -> None:
    room, gone = SharedRoom(4), list[str]()
    for _ in range(3):
        take(room, "key", gone, "lab")
    take(room, "key", gone, "hall")
    assert take(room, "key", gone, "lab") is None
    assert take(room, "key", gone, "hall") and gone == ["key lab"]
    assert take(room, "key", gone, "hall") is None
    assert take(room, "other", gone, "lab") and len(gone) == 2


def test_room_is_counted_in_bytes_and_released_once() -> None:
    room, gone = SharedRoom(100), list[str]()
    large, empty = take(room, "greedy", gone, size=90), take(room, "greedy", gone, size=0)
    small = take(room, "robot", gone, size=10)
    assert large and small and empty
    assert not room.take(large, 10), "it holds most itself"
    assert room.take(small, 10) and gone == ["greedy"] and room.held == 20
    room.release(large)
    room.release(small, 5)
    assert room.held == 15
    room.release(small)
    room.release(small)
    assert room.held == 0


def test_work_that_has_begun_is_not_undone() -> None:
    room = SharedRoom(2)
    for _ in range(2):
        assert room.take(Holding(lambda: False, caller="greedy"))
    assert room.take(Holding(lambda: False, caller="robot")) and room.held == 3
    assert not room.has_room(caller="greedy")


def test_many_refusals_of_one_caller_in_a_second_wait() -> None:
    now = 100.0
    pace = RefusalPace(lambda: now)
    assert [pace.pause("greedy") for _ in range(REFUSALS_A_SECOND)] == [0.0] * REFUSALS_A_SECOND
    assert pace.pause("greedy") == REFUSAL_SECONDS and pace.pause("robot") == 0.0
    now += 1
    assert pace.pause("greedy") == 0.0
