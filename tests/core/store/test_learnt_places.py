"""Places that are new ground of a run: they remember it, are believed from their score on, and go with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.errors import LookNameTaken, TooManyLooks
from core.maps import Enrolment
from core.places import look_address
from core.store import Map, Store
from tests.core.store.conftest import OpenStore, on_both
from tests.core.store.frames import digest_of, frame

pytestmark = on_both


def learnt(place_id: str, run: str = "s-1", least: float | None = 0.25) -> Enrolment:
    return replace(frame(place_id, x=1.0, sequence=run), run=run, least=least)


def test_they_go_with_their_run(lab: Map) -> None:
    lab.enrol([frame("a"), learnt("b"), learnt("c"), learnt("d", "s-2")])
    look = replace(frame("x"), id=look_address("b", digest_of("x").hex()[:16]), run="s-2", least=0.5)
    lab.enrol([look])
    assert lab.forget_learnt("s-1") == 0, "they are no looks"
    assert [one.run for one in lab.learnt_looks().values()] == ["s-2"]
    assert lab.forget_new_ground("s-1") == 2 and lab.forget_new_ground("s-1") == 0
    assert lab.rows_of(["b", "c"]) == [None, None] and None not in lab.rows_of(["a", "d"])
    assert lab.learnt_looks() == {}, "a look goes with its place"
    assert lab.verify().ok


def test_their_score_is_searched_with_and_survives(open_store: OpenStore, store: Store, lab: Map) -> None:
    lab.enrol([frame("a"), learnt("b")])
    assert lab.snapshot().whereabouts.least.tolist() == [-np.inf, 0.25]
    store.close()
    found = open_store().get("lab")
    assert found.snapshot().whereabouts.least.tolist() == [-np.inf, 0.25] and found.verify().ok
    assert found.forget_new_ground("s-1") == 1


def test_another_frame_makes_them_an_operators(lab: Map) -> None:
    lab.enrol([learnt("a"), learnt("b")])
    ((_, change),) = lab.enrol([replace(frame("a"), digest=digest_of("another"))])
    assert change == "replaced"
    assert lab.forget_new_ground("s-1") == 1 and lab.rows_of(["a"]) != [None]
    assert lab.snapshot().whereabouts.least[lab.rows_of(["a"])[0] or 0] == -np.inf


def test_places_and_places_with_learnt_looks_count_once_each(lab: Map) -> None:
    def look(of: str, shown: str, run: str | None) -> Enrolment:
        return replace(frame(shown), id=look_address(of, digest_of(shown).hex()[:16]), run=run)

    lab.enrol([frame("a"), frame("b"), frame("c"), learnt("d")])
    lab.enrol([look("a", "x", "s-2"), look("a", "y", "s-3"), look("b", "z", None), look("d", "u", "s-2")])
    assert lab.count_learnt() == 2, "a by two looks, d by itself and a look"
    with pytest.raises(TooManyLooks):
        lab.learn(look("c", "v", "s-2"), [], most_places=2)
    assert lab.count_learnt() == 2 and lab.place("c").looks == 0
    assert lab.learn(look("d", "v", "s-2"), [], most_places=2) == ("created", 0), "it counts already"
    assert lab.learn(look("c", "w", "s-2"), [], most_places=3) == ("created", 0)


def test_two_frames_whose_digests_begin_alike_are_no_one_look(lab: Map) -> None:
    lab.enrol([frame("a"), frame("b")])
    first, second = digest_of("x"), digest_of("x")[:8] + digest_of("y")[8:]
    address = look_address("a", first.hex()[:16])
    one, other = (replace(frame("x"), id=address, digest=digest) for digest in (first, second))
    with pytest.raises(LookNameTaken, match=first.hex()[:16]):
        lab.enrol([one, other])
    assert lab.place("a").looks == 0, "all of a batch is stored, or nothing"
    assert [change for _, change in lab.enrol([one, one])] == ["created", "unchanged"]
    with pytest.raises(LookNameTaken):
        lab.enrol([frame("c"), other])
    with pytest.raises(LookNameTaken):
        lab.learn(other, [])
    assert lab.learn(one, []) == ("unchanged", 0)
    assert lab.rows_of(["c"]) == [None] and lab.place("a").looks == 1
    ((_, change),) = lab.enrol([replace(other, id=look_address("b", first.hex()[:16]))])
    assert change == "created", "looks of several places may have one name"
    assert lab.verify().ok
