"""Traverses whose names were stored before texts had one form of Unicode: they are found by it."""

from __future__ import annotations

from unicodedata import normalize

from sqlalchemy import bindparam, update

from core.ledger import Statement
from core.ledger.maps import sequences
from core.ledger.maps.schema import SEQUENCES
from core.maps.place_filter import PlaceFilter
from core.store import Map
from tests.core.store.frames import frame

CAFE = "Café"
OLD = Statement(
    update(SEQUENCES)
    .where(SEQUENCES.c.map == bindparam("map"), SEQUENCES.c.name == bindparam("now"))
    .values(name=bindparam("old"))
)


def test_a_traverse_of_old_is_found_goes_on_and_goes(lab: Map) -> None:
    lab.enrol([frame("p0", sequence=CAFE), frame("other", sequence="Cafe")])
    with lab._transaction() as connection:
        connection.change(OLD, now=CAFE, old=normalize("NFD", CAFE))
    assert lab.unknown_sequences([CAFE, "Cafe", "Tea"]) == {"Tea"}
    lab.enrol([frame("p1", sequence=CAFE)])
    assert [place.id for place in lab.places(None, 9, PlaceFilter(sequence=CAFE))[0]] == ["p0", "p1"]
    with lab._transaction() as connection:
        code = sequences.find_code(connection, CAFE)
        assert code is not None and code in sequences.codes_of(connection, [CAFE]).values()
        assert sequences.latest(connection, CAFE, 3)[0] is not None
    assert lab.forget_sequence(CAFE) == 2


def test_of_two_that_look_the_same_the_one_of_today_comes_first(lab: Map) -> None:
    lab.enrol([frame("old", sequence=CAFE)])
    with lab._transaction() as connection:
        connection.change(OLD, now=CAFE, old=normalize("NFD", CAFE))
        sequences.new_sequence(connection, CAFE)
    lab.enrol([frame("new", sequence=CAFE)])
    assert [place.id for place in lab.places(None, 9, PlaceFilter(sequence=CAFE))[0]] == ["new"]
    assert lab.forget_sequence(CAFE) == 1
    assert [place.id for place in lab.places(None, 9, PlaceFilter(sequence=CAFE))[0]] == ["old"]
