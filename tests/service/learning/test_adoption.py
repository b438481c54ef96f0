"""What a map takes by itself: one commit for a look and those that go, and a person's word counts before the map's."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from core.errors import TooManyLooks
from core.frames.images import decode
from core.maps import Enrolment, LearningSetting, MapSettings, ReviewSetting
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder
from core.places import PlaceFields, look_address
from core.recognition.recognition import describe
from core.store import Directory, Map
from service.engine.encoders import Encoded
from service.learning.adoption import NOTHING, Adoption, Took, WaitingFrame, graph_of, waiting_frames
from tests.service.scenes import jpeg

NIGHT = jpeg(71)


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    catalogue = EncoderCatalogue()
    return catalogue.get(catalogue.resolve("m-region-vlad"))


def encoded(encoder: Encoder, data: bytes) -> Encoded:
    pixels = decode(data)
    return Encoded(pixels, encoder.encode(pixels), encoder, {})


class Hall:
    """A map of four places, a proposal for ``p1`` that waits, and what takes it."""

    def __init__(self, folder: Path, encoder: Encoder) -> None:
        self.atlas, self.encoder = Directory(folder), encoder
        settings = MapSettings(keep="none", verification=False)
        local, width = encoder.local_shape, encoder.dimension
        self.map: Map = self.atlas.create("hall", encoder.identity, width, settings, local_shape=local)
        self.map.enrol([self.frame(f"p{number}", jpeg(number)) for number in range(4)])
        (waiting,) = self.propose("p1", NIGHT)
        self.waiting = waiting

    def frame(self, place_id: str, data: bytes, run: str | None = None, look: bool = False) -> Enrolment:
        made, digest = encoded(self.encoder, data), hashlib.sha256(data).digest()
        name = look_address(place_id, digest.hex()[:16]) if look else place_id
        item = describe(self.map, name, PlaceFields(), data, digest, made.pixels, made.encoding)
        return Enrolment(**{**item.__dict__, "run": run})

    def propose(self, place: str, data: bytes) -> list[WaitingFrame]:
        told = {"place": place, "run": "s-1", "source": "robot 2026-11-20", "least_score": 0.2, "taken": None}
        assert self.map.review.keep(data, {"camera": None, "proposal": told}, ReviewSetting())
        return [one for one in waiting_frames(self.map) if one.place == place]

    def adoption(self, kind: type[Adoption] = Adoption, **setting: Any) -> Adoption:
        def encode(files: Sequence[bytes], _cameras: object, _pixels: bool) -> list[Encoded | Exception]:
            return [encoded(self.encoder, data) for data in files]

        learning = LearningSetting(mode="auto", **setting)
        return kind(self.map, self.encoder, graph_of(self.map), encode, learning)

    def adopt(self, adoption: Adoption, waiting: WaitingFrame | None = None) -> Took:
        one = waiting or self.waiting
        (row,) = self.map.rows_of([one.place])
        assert row is not None
        return adoption._adopt(one, row, "geometry")

    def runs(self, place: str = "p1") -> list[str | None]:
        return [look.run for look in self.map.looks(place)]


@pytest.fixture
def hall(tmp_path: Path, encoder: Encoder) -> Iterator[Hall]:
    made = Hall(tmp_path / "data", encoder)
    yield made
    made.atlas.close()


def test_a_proposal_becomes_a_look_and_says_so(hall: Hall) -> None:
    assert hall.adopt(hall.adoption()) == Took(1, 0)
    (look,) = hall.map.looks("p1")
    assert (look.run, look.least_score) == ("s-1", 0.2)
    label = hall.map.review.find(hall.waiting.number).label
    assert label is not None and label["label"] == {"place": "p1", "look": look.name}
    assert label["by"] == "learning (geometry)" and waiting_frames(hall.map) == []


def test_a_look_that_goes_for_another_is_counted_and_goes_in_the_same_commit(hall: Hall) -> None:
    hall.map.enrol([hall.frame("p1", jpeg(72), "s-0", look=True)])
    (row,) = hall.map.learnt_looks()
    hall.map.count_served({row: (0, 9, 0)})  # it misleads
    assert hall.adopt(hall.adoption()) == Took(1, 1)
    assert hall.runs() == ["s-1"]


def test_what_cannot_be_taken_takes_nothing_away(hall: Hall) -> None:
    hall.map.enrol([hall.frame("p1", jpeg(72), "s-0", look=True), hall.frame("p2", jpeg(73), "s-0", look=True)])
    rows = {look.name: row for row, look in hall.map.learnt_looks().items()}
    with pytest.raises(TooManyLooks):
        hall.map.learn(hall.frame("p3", NIGHT, "s-1", look=True), list(rows.values())[:1], most_places=1)
    assert (hall.runs("p1"), hall.runs("p2"), hall.runs("p3")) == (["s-0"], ["s-0"], [])
    assert hall.atlas.verify("hall").ok


def test_looks_that_people_added_count_among_those_of_a_place(hall: Hall) -> None:
    hall.map.enrol([hall.frame("p1", jpeg(72), look=True), hall.frame("p1", jpeg(73), look=True)])
    assert hall.adopt(hall.adoption(most_looks=3)) == NOTHING
    assert hall.runs() == [None, None]
    assert hall.adopt(hall.adoption(most_looks=4)) == Took(1, 0)
    assert hall.runs() == [None, None, "s-1"]


def test_a_look_that_repeats_one_that_a_person_added_is_not_taken(hall: Hall) -> None:
    hall.map.enrol([hall.frame("p1", jpeg(71, 322), look=True)])
    assert hall.adopt(hall.adoption(most_looks=9)) == NOTHING


def test_so_many_places_have_learnt_looks_at_most(hall: Hall) -> None:
    hall.map.enrol([hall.frame("p2", jpeg(72), "s-0", look=True), hall.frame("p3", jpeg(73), look=True)])
    adoption = hall.adoption(most_places=1)
    with pytest.raises(TooManyLooks):
        hall.adopt(adoption)
    (of_known,) = hall.propose("p2", jpeg(74))
    assert hall.adopt(adoption, of_known) == Took(1, 0)
    assert hall.adopt(hall.adoption(most_places=2)) == Took(1, 0)
    assert (hall.runs("p1"), hall.runs("p2"), hall.runs("p3")) == (["s-1"], ["s-0", "s-1"], [None])


def interrupted(happens: Callable[[], object]) -> type[Adoption]:
    """What takes a proposal while something happens, between its look at the frame and the commit."""

    class Interrupted(Adoption):
        def _enrolment(self, one: WaitingFrame, data: bytes, made: Encoded) -> Enrolment:
            happens()
            return super()._enrolment(one, data, made)

    return Interrupted


@pytest.mark.parametrize("said", [{"stranger": True}, {"place": "p2"}])
def test_a_person_who_is_faster_is_right(hall: Hall, said: dict[str, object]) -> None:
    review, number = hall.map.review, hall.waiting.number
    label = {"label": said, "by": "ann", "at": datetime.now(UTC).isoformat()}
    faster = interrupted(lambda: review.label(number, label))
    assert hall.adopt(hall.adoption(faster)) == NOTHING
    assert review.find(number).label == label and hall.runs() == []


def test_a_frame_that_a_person_throws_away_in_the_same_moment_teaches_nothing(hall: Hall) -> None:
    class Thrown(Adoption):
        def _claimed(self, one: WaitingFrame, item: Enrolment, grounds: str) -> bool:
            self.map.review.discard(one.number)
            return super()._claimed(one, item, grounds)

    assert hall.adopt(hall.adoption(Thrown)) == NOTHING
    assert hall.runs() == []


def test_a_person_who_accepts_the_proposal_in_the_same_moment_keeps_it(hall: Hall) -> None:
    item = hall.frame("p1", NIGHT, "s-1", look=True)

    def accept() -> None:
        hall.map.enrol([item])
        label = {"place": "p1", "look": item.id.rpartition("/")[2]}
        hall.map.review.label(hall.waiting.number, {"label": label, "by": "ann"})

    assert hall.adopt(hall.adoption(interrupted(accept))).looks == 1
    assert hall.runs() == ["s-1"]
    label = hall.map.review.find(hall.waiting.number).label
    assert label is not None and label["by"] == "ann"
