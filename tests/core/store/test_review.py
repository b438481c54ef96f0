"""Frames kept for review: bounded, durable, checked, and gone with their map."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.errors import StorageFailure, UnknownFrame, UnknownMap
from core.ledger.maps.review import Review
from core.maps import MapSettings, ReviewSetting
from core.maps.review import StoredReviews
from core.store import Directory
from tests.core.maps.review import check_pages_are_of_one_moment
from tests.core.store.edits import edit

ENCODER = "some@" + "0" * 64
SETTING = ReviewSetting(most_frames=5, most_bytes=1 << 16)
ANSWER = {"verdict": "unknown", "score": 0.25, "camera": None, "text": "naïve\u2028 <b>"}


class Opened(Review):
    """The frames of the map "lab" of a data directory, which is made if it is missing."""

    def __init__(self, folder: Path) -> None:
        self.store = Directory(folder / "data")
        listed = self.store.records(None, 1)[0]
        found = self.store.get("lab") if listed else self.store.create("lab", ENCODER, 8)
        super().__init__(found.review._reading, found.review._writing)

    def close(self) -> None:
        self.store.close()


def frames_at(folder: Path) -> Opened:
    return Opened(folder)


def test_a_frame_is_stored_with_its_answer_and_survives_a_restart(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    assert review.page(None, 10) == StoredReviews([], 0, 0)
    assert review.keep(b"one", ANSWER, SETTING) and review.keep(b"two", {"verdict": "ambiguous"}, SETTING)
    assert not review.keep(b"one", ANSWER, SETTING), "the same file is kept once"
    review.label(1, {"label": {"place": "p7"}})
    review.close()
    again = frames_at(tmp_path)
    second, first = again.page(None, 10).frames
    assert (first.number, second.number) == (1, 2) and first.answer == ANSWER and first.size == 3
    assert first.label == {"label": {"place": "p7"}} and second.label is None
    assert [again.picture(one.number) for one in (first, second)] == [b"one", b"two"]
    assert again.page(2, 10) == StoredReviews([first], 2, 6) and again.page(None, 1) == StoredReviews([second], 2, 6)
    assert again.page(None, 10, labelled=True).frames == again.labelled() == [first]
    assert again.page(None, 10, labelled=False).frames == [second]
    again.close()


def test_a_page_is_of_one_moment(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    check_pages_are_of_one_moment(review, review)
    review.close()


def test_a_frame_that_is_not_stored_is_named(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    for action in (review.find, review.picture, review.discard, lambda number: review.label(number, {})):
        with pytest.raises(UnknownFrame):
            action(1)
    review.keep(b"one", ANSWER, SETTING)
    review.discard(1)
    with pytest.raises(UnknownFrame):
        review.picture(1)
    assert review.keep(b"one", ANSWER, SETTING) and review.find(2).size == 3, "a number is never used again"
    review.close()


@pytest.mark.thorough
@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(1, 30_000), st.booleans()), max_size=14))
def test_the_oldest_go_first_and_those_with_a_label_last(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[int, bool]]
) -> None:
    review = frames_at(tmp_path_factory.mktemp("review"))
    expected: list[tuple[int, int, bool]] = []  # number, size, label
    for number, (size, labelled) in enumerate(frames, start=1):
        assert review.keep(number.to_bytes(2, "big") * size, ANSWER, SETTING) == (2 * size <= SETTING.most_bytes)
        expected.append((number, 2 * size, False))
        while len(expected) > SETTING.most_frames or sum(size for _, size, _ in expected) > SETTING.most_bytes:
            expected.remove(min(expected, key=lambda one: (one[2], one[0])))
        if labelled and expected and expected[-1][0] == number:
            review.label(number, {"label": {"stranger": True}})
            expected[-1] = (number, 2 * size, True)
    page = review.page(None, 100)
    kept = [(one.number, one.size, one.label is not None) for one in reversed(page.frames)]
    assert kept == expected and (page.count, page.size) == (len(expected), sum(size for _, size, _ in expected))
    review.close()


def test_a_frame_larger_than_all_may_be_is_not_stored(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    review.keep(b"one", ANSWER, SETTING)
    assert not review.keep(bytes(SETTING.most_bytes + 1), ANSWER, SETTING)
    assert (review.page(None, 0).count, review.page(None, 0).size) == (1, 3)
    review.close()


def test_lower_limits_give_back_the_room(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    wide = ReviewSetting(most_frames=100, most_bytes=1 << 24)
    for number in range(20):
        review.keep(bytes([number]) * 100_000, ANSWER, wide)
    review.shrink(ReviewSetting(most_frames=2, most_bytes=1 << 24))
    assert [one.number for one in review.page(None, 10).frames] == [20, 19]
    review.close()


def test_a_frame_that_is_held_is_not_dropped_for_newer_ones(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    setting = ReviewSetting(most_frames=2, most_bytes=1 << 20)
    for number in range(4):
        with review.held(1):
            review.keep(bytes([number]), ANSWER, setting)
    assert [one.number for one in review.page(None, 10).frames] == [4, 1]
    review.keep(b"next", ANSWER, setting)
    assert [one.number for one in review.page(None, 10).frames] == [5, 4]
    review.close()


def test_what_does_not_match_its_checksum_is_not_shown(tmp_path: Path) -> None:
    """Verifying names it; a frame that is damaged can be discarded."""
    review = frames_at(tmp_path)
    for number in range(4):
        review.keep(bytes([number]) * 100, ANSWER, SETTING)
    review.close()
    edit(
        tmp_path / "data/maps/lab",
        "UPDATE review_frames SET answer = replace(answer, 'unknown', 'unknowm') WHERE number = 1",
        "UPDATE review_pictures SET bytes = x'FF' WHERE number = 2",
        "DELETE FROM review_pictures WHERE number = 3",
    )
    review = frames_at(tmp_path)
    assert [one.number for one in review.page(None, 10).frames] == [4, 3, 2]
    for action in (review.find, lambda number: review.label(number, {"label": {}})):
        with pytest.raises(StorageFailure, match="damaged"):
            action(1)
    for number in (2, 3):
        with pytest.raises(StorageFailure, match="damaged"):
            review.picture(number)
    assert review.picture(4) == b"\x03" * 100
    assert review.store.verify("lab").problems == [
        "map.sqlite: frame 1 for review does not match its checksum",
        *(f"map.sqlite: the picture of frame {number} for review does not match its digest" for number in (2, 3)),
    ]
    for number in (1, 2, 3):
        review.discard(number)
    assert review.store.verify("lab").ok
    review.close()


def test_kept_frames_go_with_their_map(tmp_path: Path) -> None:
    atlas = Directory(tmp_path / "data")
    map_ = atlas.create("lab", ENCODER, 8, MapSettings(review=SETTING))
    assert map_.review.keep(b"one", ANSWER, SETTING)
    folder = tmp_path / "data" / "maps" / "lab"
    assert atlas.verify("lab").ok
    atlas.delete("lab")
    assert not folder.exists()
    with pytest.raises(UnknownMap):
        map_.review.keep(b"two", ANSWER, SETTING)
    made = atlas.create("lab", ENCODER, 8)
    assert made.review.page(None, 10).frames == [] and made.record.review is None
    atlas.close()


def test_the_setting_survives_a_restart(tmp_path: Path) -> None:
    atlas = Directory(tmp_path / "data")
    atlas.create("lab", ENCODER, 8)
    setting = ReviewSetting(verdicts=("recognized",), most_frames=7)
    assert atlas.get("lab").edit({"review": setting}).revision == 2
    atlas.close()
    atlas = Directory(tmp_path / "data")
    assert atlas.get("lab").record.review == setting
    assert atlas.get("lab").edit({"review": None}).review is None
    atlas.close()
