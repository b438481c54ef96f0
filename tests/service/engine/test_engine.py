"""Locks of maps: each has one holder at a time, and no lock is left behind."""

from __future__ import annotations

import threading

from service.engine.engine import MapLocks


def test_one_holder_at_a_time_and_nothing_is_left() -> None:
    locks, inside, most = MapLocks(), list[int](), list[int]()

    def work(number: int) -> None:
        for _ in range(50):
            with locks.of("lab"), locks.of("lab"):
                inside.append(number)
                most.append(len(inside))
                inside.remove(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(most) == {1} and len(most) == 200
    assert len(locks) == 0
