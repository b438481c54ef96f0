"""The cameras of a map under many threads."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from core.errors import UnknownCamera
from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.writing import Write
from core.store import Map, Store
from tests.core.store.conftest import OpenStore, on_both

MASK = Mask(polygons=(((0.0, 0.0), (1.0, 0.0), (1.0, 0.2)),))
INTRINSICS = Intrinsics(width=64, height=48, fx=50.1, fy=50.2, cx=31.5, cy=23.5)
SECONDS = 30.0


@on_both
def test_what_was_put_is_known_at_once_and_what_was_forgotten_is_not(lab: Map) -> None:
    assert lab.cameras.all() == []
    assert lab.cameras.put("front", None)[1]
    assert lab.cameras.mask("front") is None
    assert not lab.cameras.put("front", MASK)[1]
    assert lab.cameras.mask("front") == MASK
    lab.cameras.forget("front")
    with pytest.raises(UnknownCamera):
        lab.cameras.mask("front")


@on_both
def test_intrinsics_are_stored_beside_the_mask(open_store: OpenStore, store: Store, lab: Map) -> None:
    lab.cameras.put("front", MASK, INTRINSICS)
    lab.cameras.put("back", None)
    store.close()
    again = open_store().get("lab").cameras
    assert again.find("front").intrinsics == again.intrinsics("front") == INTRINSICS
    assert again.intrinsics("back") is again.intrinsics("gone") is again.intrinsics(None) is None
    again.put("front", None)
    assert again.find("front").intrinsics is None


@pytest.mark.parametrize("mask", [None, MASK])
def test_a_range_of_values_goes_with_the_mask_of_frames(
    mask: Mask | None, open_store: OpenStore, store: Store, lab: Map
) -> None:
    lab.cameras.put("front", mask, None, (0, 1023))
    before = lab.cameras.mask("front")
    lab.cameras.put("front", mask, None, (0, 4095))
    store.close()
    cameras = open_store().get("lab").cameras
    assert cameras.find("front").settings() == (mask, None, (0, 4095))
    used = cameras.mask("front")
    assert used is not None and before is not None and used.digest != before.digest
    assert used.covered(8, 8).any() == (mask is not None)
    cameras.put("front", mask)
    assert cameras.mask("front") == mask


@on_both
def test_cameras_are_read_while_another_thread_waits_to_change_them(lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one who keeps others from writing asks for them; neither may wait for the other."""
    lab.cameras.put("front", None)
    waiting, found, writing = threading.Event(), [], lab.cameras._writing

    @contextmanager
    def told() -> Iterator[Write]:
        waiting.set()
        with writing() as write:
            yield write

    monkeypatch.setattr(lab.cameras, "_writing", told)
    changing = threading.Thread(target=lambda: lab.cameras.put("back", MASK), daemon=True)
    asking = threading.Thread(target=lambda: found.append(lab.cameras.all()), daemon=True)
    with lab.transfer.paused_writes():
        changing.start()
        assert waiting.wait(SECONDS)
        asking.start()
        asking.join(SECONDS)
        assert [[camera.name for camera in cameras] for cameras in found] == [["front"]]
    changing.join(SECONDS)
    assert lab.cameras.mask("back") == MASK


def test_a_reading_before_a_change_is_not_cached(lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.cameras.put("front", None)
    reading = lab.cameras._reading

    @contextmanager
    def slow() -> Iterator[MapConnection]:
        """The mask is changed between the reading and what is made of it."""
        with reading() as connection:
            yield connection
        monkeypatch.undo()
        lab.cameras.put("front", MASK)

    monkeypatch.setattr(lab.cameras, "_reading", slow)
    assert lab.cameras.mask("front") is None
    assert lab.cameras.mask("front") == MASK
