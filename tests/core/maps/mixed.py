"""Maps whose places have coordinates of both kinds, as they could be made before a map had one kind."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import patch

from core.errors import MixedCoordinates
from core.ledger.maps.writing import Write
from core.maps import Enrolment
from core.places import PlaceFields, Pose
from core.store import Map
from tests.core.store.frames import frame


@contextmanager
def both_kinds() -> Iterator[None]:
    """Have writes take poses of either kind."""
    with patch.object(Write, "_expect_coordinates", lambda *_: None):
        yield


POSES = Pose(x=1.0, y=2.0), Pose(latitude=48.8, longitude=2.3)


def posed(place_id: str, pose: Pose | None, picture: str | None = None) -> Enrolment:
    """A frame with a pose."""
    return replace(frame(place_id, picture), fields=PlaceFields(pose=pose))


def check_one_kind_wins(one: Map, other: Map, rounds: int = 10) -> None:
    """Have two writers enrol places of both kinds at once into a map without places; both may be one object."""
    both = threading.Barrier(2)

    def enrol(map_: Map, pose: Pose) -> bool:
        both.wait(60)
        try:
            map_.enrol([posed(pose.kind(), pose)])
        except MixedCoordinates:
            return False
        return True

    with ThreadPoolExecutor(2) as pool:
        for _ in range(rounds):
            taken = list(pool.map(enrol, (one, other), POSES))
            assert sorted(taken) == [False, True]
            kept = POSES[taken.index(True)].kind()
            assert [place.id for place in one.places(None, 9)[0]] == [kept]
            one.forget(kept)
