"""Sequences: their codes, the positions in them, and their ends."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import bindparam, delete, insert, update

from core.ledger import Statement
from core.ledger.maps import places, record, sequences
from core.ledger.maps.schema import MAPS, PLACES, SEQUENCES
from core.maps.counterparts import Correspondence
from core.places import NO_SEQUENCE, PlaceFields
from core.store import Map
from tests.core.store.frames import frame


def code_of(lab: Map, name: str) -> int:
    with lab._transaction() as connection:
        return sequences.codes_of(connection, [name])[name]


def test_the_frame_enrolled_last_is_among_the_last_wherever_its_view_is(lab: Map) -> None:
    lab.enrol([frame(f"p{n}", picture, sequence="walk") for n, picture in enumerate("abcdefeed")])
    code = code_of(lab, "walk")
    assert [place.ordinal for place in lab.transfer.outline()] == [0, 1, 2, 3, 4, 5, 4, 4, 3]
    with lab._transaction() as connection:
        assert [sequences.oldest_of_last(connection, code, last) for last in (1, 2, 6, 7)] == [3, 3, 3, 2]
        assert sequences.oldest_of_last(connection, code, 99) == 0
        assert sequences.oldest_of_last(connection, 77, 2) is None
        assert sequences.latest(connection, "walk", 2) == ((3, 8), {3: 3, 4: 4, 5: 5})
        assert sequences.latest(connection, "never", 2) == (None, {})


def test_rows_at_a_position_and_beside_it(lab: Map) -> None:
    lab.enrol([frame(f"p{n}", picture, sequence="walk") for n, picture in enumerate("abaa")])
    assert [place.ordinal for place in lab.transfer.outline()] == [0, 1, 0, 0]
    code = code_of(lab, "walk")
    with lab._transaction() as connection:
        assert sequences.first_at(connection, code, 0) == 0
        assert sequences.first_at(connection, code, 0, before=1) is None
        assert sequences.first_at(connection, code, 7) is None
        assert sequences.beside(connection, code, 0, number=3, row=2) == []
        connection.change(MOVE, which=0, other=9)  # the first place got a frame after that of the third
        assert sorted(sequences.beside(connection, code, 0, number=3, row=2)) == [3, 9]
        connection.change(MOVE, which=9, other=0)


MOVE = Statement(
    update(PLACES)
    .where(PLACES.c.map == bindparam("map"), PLACES.c.row == bindparam("which"))
    .values(row=bindparam("other"))
)


def test_a_sequence_goes_with_its_last_place_and_its_code_is_never_used_again(lab: Map) -> None:
    lab.enrol([frame(f"p{i}", sequence="monday" if i % 2 else "tuesday") for i in range(6)])
    monday, tuesday = code_of(lab, "monday"), code_of(lab, "tuesday")
    assert lab.forget_sequence("monday") == 3
    with lab._transaction() as connection:
        assert sequences.codes_of(connection, ["monday", "tuesday"]) == {"tuesday": tuesday}
        assert [one.name for one in sequences.summaries_after(connection, "", 9)] == ["tuesday"]
        assert sequences.ends(connection) == {None: 0, "tuesday": 3}
        assert len(sequences.rows_of(connection, "tuesday")) == 3 and sequences.rows_of(connection, "monday") == []
    lab.set_fields("p0", PlaceFields(sequence="monday"))
    assert code_of(lab, "monday") not in (monday, tuesday, NO_SEQUENCE)
    for place_id in ("p0", "p2", "p4"):
        lab.set_fields(place_id, PlaceFields())
    with lab._transaction() as connection:
        assert sequences.ends(connection) == {None: 3}
        assert (sequences.wrong(connection), sequences.lost(connection)) == ([], [])


def of_sequence(values: dict[str, Any]) -> Statement:
    return Statement(
        update(SEQUENCES).where(SEQUENCES.c.map == bindparam("map"), SEQUENCES.c.name == "walk").values(values)
    )


DAMAGES: dict[str, tuple[Statement, list[str | None], list[str]]] = {
    "an end before the last place": (of_sequence({"next_ordinal": 1}), ["walk"], []),
    "a sequence without places": (
        Statement(insert(SEQUENCES).values(map=bindparam("map"), code=77, name="empty", next_ordinal=0)), ["empty"], [],
    ),
    "a sequence that is missing": (
        Statement(delete(SEQUENCES).where(SEQUENCES.c.map == bindparam("map"), SEQUENCES.c.name == "walk")),
        [], ["p0", "p1"],
    ),
    "another code": (of_sequence({"code": 77}), ["walk"], ["p0", "p1"]),
    "the end of the places without a sequence": (
        Statement(
            update(SEQUENCES)
            .where(SEQUENCES.c.map == bindparam("map"), SEQUENCES.c.code == NO_SEQUENCE)
            .values(next_ordinal=0)
        ),
        [None], [],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("damage", "wrong", "lost"), DAMAGES.values(), ids=DAMAGES)
def test_sequences_that_contradict_the_places_are_found(
    lab: Map, damage: Statement, wrong: list[str | None], lost: list[str]
) -> None:
    lab.enrol([frame("p0", sequence="walk"), frame("p1", sequence="walk"), frame("alone")])
    with lab._transaction() as connection:
        assert (sequences.wrong(connection), sequences.lost(connection)) == ([], [])
        connection.change(damage)
        assert (sequences.wrong(connection), sequences.lost(connection)) == (wrong, lost)


@pytest.mark.parametrize(
    ("counter", "value", "problem"),
    [
        ("numbers", 3, "the next number of a place, 3, is not above those there are"),
        ("codes", 1, "the next code of a sequence, 1, is not above those there are"),
        ("revision", 1, "the revision, 1, is below those of places"),
    ],
)
def test_counters_that_would_repeat_themselves_are_found(lab: Map, counter: str, value: int, problem: str) -> None:
    lab.enrol([frame(f"p{i}", sequence=f"s{i % 2}") for i in range(3)])
    lab.counterparts.store(Correspondence({0: (code_of(lab, "s1"), 0)}, {}))
    lab.forget_sequence("s1")  # whose code is that of a track yet
    spoil = Statement(update(MAPS).where(MAPS.c.number == bindparam("map")).values({counter: value}))
    with lab._transaction() as connection:
        assert record.wrong_counters(connection) == []
        connection.change(spoil)
        assert record.wrong_counters(connection) == [problem]


def test_counters_grow_with_every_write(lab: Map) -> None:
    states = [lab.latest()]
    for write in (
        lambda: lab.enrol([frame("p0", sequence="s"), frame("p1")]),
        lambda: lab.enrol([frame("p0", "another picture", sequence="s")]),
        lambda: lab.patch("p1", {"metadata": {"n": 1}}),
        lambda: lab.edit({"description": "a hall"}),
        lambda: lab.cameras.put("front", None),
        lambda: lab.forget("p0"),
    ):
        write()
        states.append(lab.latest())
    assert [(one.places, one.rows, one.numbers) for one in states] == [
        (0, 0, 1), (2, 2, 3), (2, 3, 3), (2, 3, 3), (2, 3, 3), (2, 3, 3), (1, 3, 3),
    ]  # fmt: skip
    assert [one.revision for one in states] == list(range(7))
    lab.enrol([frame("p1", metadata={"n": 1})])
    assert lab.latest() == states[-1], "nothing changes"
    with lab._transaction() as connection:
        assert places.expect(connection, "p1").revision == 3
