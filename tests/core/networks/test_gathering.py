"""Callers of one pass get their own images' maps, in batches of what waited."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from core.networks.backbone import Array
from core.networks.gathering import GatheredPass
from core.threads import each


class Lane:
    """Doubles images and counts their channels; remembers its batches, and can be held up."""

    def __init__(self) -> None:
        self.batches: list[int] = []
        self.free, self.entered = threading.Event(), threading.Event()
        self.free.set()

    def __call__(self, images: Array) -> tuple[Array, ...]:
        self.entered.set()
        assert self.free.wait(20)
        self.batches.append(len(images))
        if np.isnan(images).any():
            raise ValueError("not a number")
        return images * 2, images.sum((1, 2, 3))


def image(value: float, count: int = 1, side: int = 2) -> Array:
    return np.full((count, side, side, 3), value, np.float32)


@contextmanager
def held(lane: Lane, gathered: GatheredPass) -> Iterator[None]:
    """The lane is busy with one image until this ends."""
    lane.free.clear()
    lane.entered.clear()
    thread = threading.Thread(target=gathered, args=(image(0),))
    thread.start()
    assert lane.entered.wait(20)
    try:
        yield
    finally:
        lane.free.set()
        thread.join(20)


def called(gathered: GatheredPass, shown: list[Array]) -> list[threading.Thread]:
    """Threads that call one after the other and now wait."""
    threads = []
    for count, images in enumerate(shown, 1):
        threads.append(threading.Thread(target=gathered, args=(images,)))
        threads[-1].start()
        until = time.monotonic() + 20
        while len(gathered._waiting) < count and time.monotonic() < until:
            time.sleep(0.001)
    return threads


def test_each_caller_gets_the_maps_of_its_own_images() -> None:
    lanes = [Lane(), Lane()]
    gathered = GatheredPass(lanes, 4)
    found = each(lambda value: gathered(image(value, 1 + value % 3)), range(60), 12)
    for value, (doubled, sums) in enumerate(found):
        count = 1 + value % 3
        assert np.array_equal(doubled, image(2 * value, count)) and sums.tolist() == [12.0 * value] * count
    assert sum(lanes[0].batches + lanes[1].batches) == sum(1 + value % 3 for value in range(60))
    assert max(lanes[0].batches + lanes[1].batches) <= 4


def test_what_waits_is_computed_together_up_to_the_most_and_one_shape_at_a_time() -> None:
    lane = Lane()
    gathered = GatheredPass([lane], 4)
    with held(lane, gathered):
        threads = called(gathered, [image(1), image(2, 2), image(3, 2), image(4, 9), image(5), image(6, side=3)])
    for thread in threads:
        thread.join(20)
    assert lane.batches == [1, 3, 2, 9, 1, 1]


def test_an_error_reaches_those_whose_images_were_in_the_batch_and_nobody_later() -> None:
    lane = Lane()
    gathered = GatheredPass([lane], 4)
    with pytest.raises(ValueError, match="not a number"):
        gathered(image(float("nan")))
    assert np.array_equal(gathered(image(1))[0], image(2))
