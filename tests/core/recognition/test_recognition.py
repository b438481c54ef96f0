"""The whole path from a picture to an answer, on a real map with a real encoder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.errors import NoRegions, UnknownCamera, UnknownPlace
from core.frames.images import decode, encode_png
from core.judgement.verdict import TOP_PLACES
from core.maps import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question
from core.recognition.recognition import ATTEMPTS, enrol, locate, recognize
from core.recognition.stages import likeness, rank_places
from core.store import Directory, Map, Snapshot
from tests.service.encoders import SECOND_STAGE
from tests.service.scenes import jpeg, scene, seen_again

PLACES = 8
CANDIDATES = SECOND_STAGE.candidates
EXAMINED = max(CANDIDATES, 1 + TOP_PLACES)
"""The best one and enough others to hold it against; all places are places of their own here."""


@pytest.fixture(scope="module")
def seen(encoder: Encoder) -> list[Encoding]:
    """Of the places p0, p1 …"""
    return [encoder.encode(scene(seed)) for seed in range(PLACES)]


@pytest.fixture(scope="module")
def query(encoder: Encoder) -> Encoding:
    """Of the place p3, seen again."""
    return encoder.encode(seen_again(scene(3)))


@pytest.fixture
def lab(tmp_path: Path, encoder: Encoder, seen: list[Encoding]) -> Iterator[Map]:
    """A map of all places, ten metres apart, over several segments."""
    atlas = Directory(tmp_path, rows_per_segment=3)
    lab = atlas.create("lab", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    lab.enrol([enrolment(f"p{i}", encoding) for i, encoding in enumerate(seen)])
    yield lab
    atlas.close()


def enrolment(place_id: str, encoding: Encoding) -> Enrolment:
    content = encoding.descriptor.tobytes() + encoding.local.tobytes()
    return Enrolment(
        id=place_id,
        fields=PlaceFields(pose=Pose(x=10 * float(place_id[1:]), y=0)),
        descriptor=encoding.descriptor,
        local=encoding.local,
        regions=len(encoding.regions),
        digest=hashlib.sha256(content).digest(),
    )


@pytest.mark.thorough
def test_neighbours_that_fill_the_shortlist_do_not_hide_rivals(
    tmp_path: Path, encoder: Encoder, seen: list[Encoding], query: Encoding, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("core.store.snapshot.SHORTLIST", 20)
    atlas = Directory(tmp_path)
    crowded = atlas.create(
        "crowded", encoder.identity, encoder.dimension, MapSettings(keep="none", index="compact"), encoder.local_shape
    )
    crowded.enrol([enrolment(f"p{i}", encoding) for i, encoding in enumerate(seen)])
    crowded.enrol([replace(enrolment("p3", seen[3]), id=f"again{i}") for i in range(40)])
    rows, _ = crowded.snapshot().search(query.descriptor)
    assert len(rows) == 20 and {place and place.id[:5] for place in crowded.places_at(rows.tolist())} <= {"p3", "again"}
    (found,) = locate(crowded, encoder, [Query(query)])
    assert found.judgement.rival is not None and found.judgement.margin is not None
    others = [place for place in both_stages(encoder, seen, query) if place != "p3"]
    assert found.candidates.rows[found.judgement.rival] == int(others[0][1:])
    atlas.close()


def first_stage(encoder: Encoder, places: list[Encoding], query: Encoding) -> dict[str, float]:
    """Score by id, of the descriptors alone."""
    products = np.stack([place.descriptor for place in places]) @ query.descriptor
    return {f"p{i}": float(score) for i, score in enumerate(encoder.scores_from_inner_products(products))}


def both_stages(encoder: Encoder, places: list[Encoding], query: Encoding) -> dict[str, float]:
    """Score by id, best first: one place after the other."""
    scores = first_stage(encoder, places, query)
    for place_id in sorted(scores, key=lambda name: -scores[name])[:EXAMINED]:
        scores[place_id] += float(encoder.agreement(query.local, places[int(place_id[1:])].local[np.newaxis])[0])
    return dict(sorted(scores.items(), key=lambda item: -item[1]))


def assert_matches(matches: list[tuple[float, str]], expected: dict[str, float]) -> None:
    assert [place_id for _, place_id in matches] == list(expected)
    np.testing.assert_allclose([score for score, _ in matches], list(expected.values()), atol=1e-5)


def found(lab: Map, encoder: Encoder, query: Encoding, k: int = PLACES) -> list[tuple[float, str]]:
    (located,) = locate(lab, encoder, [Query(query, Question(k))])
    assert located.search > 0
    assert located.judgement.score == (located.matches[0][0] if located.matches else None)
    return [(score, place.id) for score, place in located.matches]


def test_only_the_best_places_gain_by_the_second_stage(
    lab: Map, encoder: Encoder, seen: list[Encoding], query: Encoding
) -> None:
    expected, without = both_stages(encoder, seen, query), first_stage(encoder, seen, query)
    assert sum(expected[place_id] > without[place_id] for place_id in expected) == EXAMINED
    assert_matches(found(lab, encoder, query), expected)
    assert_matches(found(lab, encoder, query, k=2), dict(list(expected.items())[:2]))


def test_queries_together_have_the_same_answers_as_alone(lab: Map, encoder: Encoder, seen: list[Encoding]) -> None:
    queries = [encoder.encode(seen_again(scene(seed))) for seed in (1, 5, 6)]
    for one, located in zip(
        queries, locate(lab, encoder, [Query(query, Question(PLACES)) for query in queries]), strict=True
    ):
        matches = [(score, place.id) for score, place in located.matches]
        assert_matches(matches, both_stages(encoder, seen, one))


def test_an_examined_place_that_agrees_cell_by_cell_comes_first(
    lab: Map, encoder: Encoder, seen: list[Encoding], query: Encoding
) -> None:
    """The third by its descriptor shows the very cells of the query, the first two show none of them."""
    order = sorted(first_stage(encoder, seen, query).items(), key=lambda item: -item[1])
    names = [place_id for place_id, _ in order]
    places = list(seen)
    for rank, place_id in enumerate(names):
        local = query.local if rank in (EXAMINED - 1, EXAMINED) else np.zeros_like(query.local)
        number = int(place_id[1:])
        places[number] = replace(seen[number], local=local)
        assert lab.enrol([enrolment(place_id, places[number])])[0][1] == "replaced"
    matches = found(lab, encoder, query)
    assert [place_id for _, place_id in matches] == [names[EXAMINED - 1], *names[: EXAMINED - 1], *names[EXAMINED:]]
    assert_matches(matches, both_stages(encoder, places, query))
    (itself,) = encoder.agreement(query.local, query.local[np.newaxis])
    assert matches[0][0] == pytest.approx(order[EXAMINED - 1][1] + itself, abs=1e-5)
    assert itself > 0.5 * SECOND_STAGE.share


class Late:
    """A map whose first snapshots are from before its last writes, as a search sees it under which places go."""

    def __init__(self, lab: Map, stale: Snapshot, times: int) -> None:
        self._lab, self._stale, self.left = lab, stale, times

    def __call__(self) -> Snapshot:
        self.left -= 1
        return self._stale if self.left >= 0 else Map.snapshot(self._lab)


def test_a_place_deleted_during_the_search_is_replaced_by_the_next(
    lab: Map, encoder: Encoder, seen: list[Encoding], query: Encoding, monkeypatch: pytest.MonkeyPatch
) -> None:
    best = next(iter(both_stages(encoder, seen, query)))
    stale = lab.snapshot()
    lab.forget(best)
    monkeypatch.setattr(lab, "snapshot", Late(lab, stale, 1))
    scores = first_stage(encoder, seen, query)
    left = sorted((name for name in scores if name != best), key=lambda name: -scores[name])
    # A place that was fourth before is among the first three now, and is examined as they are.
    for place_id in left[:EXAMINED]:
        scores[place_id] += float(encoder.agreement(query.local, seen[int(place_id[1:])].local[np.newaxis])[0])
    expected = {name: scores[name] for name in sorted(left, key=lambda name: -scores[name])}
    assert_matches(found(lab, encoder, query), expected)


def test_a_place_replaced_during_the_search_is_compared_by_its_new_frame(
    lab: Map, encoder: Encoder, seen: list[Encoding], query: Encoding, monkeypatch: pytest.MonkeyPatch
) -> None:
    best = next(iter(both_stages(encoder, seen, query)))
    stale = lab.snapshot()
    places = list(seen)
    places[int(best[1:])] = encoder.encode(scene(77))
    lab.enrol([enrolment(best, places[int(best[1:])])])
    monkeypatch.setattr(lab, "snapshot", Late(lab, stale, 1))
    assert_matches(found(lab, encoder, query), both_stages(encoder, places, query))


def test_while_places_go_on_being_deleted_the_others_are_listed(
    lab: Map, encoder: Encoder, seen: list[Encoding], query: Encoding, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = both_stages(encoder, seen, query)
    best = next(iter(expected))
    stale = lab.snapshot()
    lab.forget(best)
    late = Late(lab, stale, ATTEMPTS)
    monkeypatch.setattr(lab, "snapshot", late)
    matches = found(lab, encoder, query, k=4)
    assert late.left == 0
    assert_matches(matches, {name: expected[name] for name in list(expected)[1:4]})


def test_an_empty_map(lab: Map, encoder: Encoder, query: Encoding) -> None:
    for i in range(PLACES):
        lab.forget(f"p{i}")
    assert found(lab, encoder, query) == []


def test_a_picture_is_enrolled_and_recognized(lab: Map, encoder: Encoder) -> None:
    place = enrol(lab, "here", jpeg(40), encoder, PlaceFields(pose=Pose(x=500, y=0), metadata={"floor": 1}))
    assert place.id == "here" and lab.place("here") == place and lab.count_places() == PLACES + 1
    answer = recognize(lab, jpeg(40), encoder, Question(k=2))
    assert answer.matches[0][1] == place and len(answer.matches) == 2
    assert answer.place == (place if answer.judgement.verdict == "recognized" else None)
    (located,) = locate(lab, encoder, [Query(encoder.encode(decode(jpeg(40))), Question(2))])
    assert located.judgement == answer.judgement and located.matches == answer.matches


def test_a_blank_picture_shows_no_place(lab: Map, encoder: Encoder) -> None:
    blank = encode_png(np.zeros((64, 64, 3), np.uint8))
    answer = recognize(lab, blank, encoder)
    assert answer.blank and answer.judgement.verdict == "unknown" and answer.matches == []
    assert (answer.place, answer.probability, answer.pose) == (None, None, None)
    with pytest.raises(NoRegions, match="blank"):
        enrol(lab, "blank", blank, encoder)
    assert lab.count_places() == PLACES


def test_a_camera_must_be_known(lab: Map, encoder: Encoder) -> None:
    with pytest.raises(UnknownCamera):
        recognize(lab, jpeg(40), encoder, Question(camera="rear"))
    with pytest.raises(UnknownCamera):
        enrol(lab, "here", jpeg(40), encoder, PlaceFields(camera="rear"))


@pytest.fixture
def rooms(tmp_path: Path) -> Iterator[tuple[Map, Encoder]]:
    """An empty map of the packaged default."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    atlas = Directory(tmp_path)
    yield atlas.create("rooms", encoder.identity, encoder.dimension, local_shape=encoder.local_shape), encoder
    atlas.close()


def test_two_places_of_one_picture_are_one_group_of_rivals(rooms: tuple[Map, Encoder]) -> None:
    lab, encoder = rooms
    enrol(lab, "first", jpeg(1), encoder)
    assert recognize(lab, jpeg(1), encoder).judgement.verdict == "recognized"
    enrol(lab, "second", jpeg(1), encoder)
    answer = recognize(lab, jpeg(1), encoder)
    assert (answer.judgement.verdict, answer.place) == ("ambiguous", None)
    assert answer.probability is not None and answer.probability <= 0.5
    assert [(group.places, group.same_place) for group in answer.rivals] == [(("second",), True)]
    assert answer.rivals[0].score == pytest.approx(answer.matches[0][0], abs=1e-6)


def test_a_rival_that_is_deleted_meanwhile_is_no_rival(
    rooms: tuple[Map, Encoder], monkeypatch: pytest.MonkeyPatch
) -> None:
    lab, encoder = rooms
    for name in ("first", "second"):
        enrol(lab, name, jpeg(1), encoder)
    (candidates,) = rank_places(lab, encoder, [encoder.encode(decode(jpeg(1)))])
    positions = np.array([1])
    assert likeness(lab, encoder, candidates, positions)[0] > 0.5

    def gone(self: Snapshot, rows: np.ndarray) -> np.ndarray:
        raise UnknownPlace("A place was deleted while it was read.")

    monkeypatch.setattr(Snapshot, "descriptors_at", gone)
    assert likeness(lab, encoder, candidates, positions).tolist() == [0.0]
