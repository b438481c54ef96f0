"""Frames kept for review: bounded, durable, checked, and gone with their map."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from core.storage.review import FILE, ReviewFrames
from core.storage.verification import inspect_folder
from hypothesis import given, settings
from hypothesis import strategies as st

from core.errors import StorageFailure, UnknownFrame, UnknownMap
from core.maps import MapSettings, ReviewSetting
from core.maps.review import StoredReviews
from core.store import Directory
from tests.core.maps.review import check_pages_are_of_one_moment

ENCODER = "some@" + "0" * 64
SETTING = ReviewSetting(most_frames=5, most_bytes=1 << 16)
ANSWER = {"verdict": "unknown", "score": 0.25, "camera": None, "text": "naïve\u2028 <b>"}


def frames_at(folder: Path) -> ReviewFrames:
    return ReviewFrames(folder / FILE, "lab", lambda: None)


def test_a_frame_is_stored_with_its_answer_and_survives_a_restart(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    assert review.page(None, 10) == StoredReviews([], 0, 0) and not (tmp_path / FILE).exists()
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
    assert (tmp_path / FILE).stat().st_size < 500_000


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


def edit(path: Path, statement: str, *values: object) -> None:
    connection = sqlite3.connect(path)
    with connection:
        connection.execute(statement, values)
    connection.close()


def test_what_does_not_match_its_checksum_is_not_shown(tmp_path: Path) -> None:
    review = frames_at(tmp_path)
    for number in range(3):
        review.keep(bytes([number]), ANSWER, SETTING)
    review.close()
    edit(tmp_path / FILE, "UPDATE review_frames SET answer = replace(answer, 'unknown', 'unknowm') WHERE number = 1")
    edit(tmp_path / FILE, "UPDATE review_pictures SET bytes = x'FF' WHERE number = 2")
    review = frames_at(tmp_path)
    assert [one.number for one in review.page(None, 10).frames] == [3, 2]
    with pytest.raises(StorageFailure, match="damaged"):
        review.picture(2)
    assert review.picture(3) == b"\x02"
    review.close()


def test_a_damaged_file_is_put_aside_and_the_map_goes_on(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"no database at all" * 100)
    review = frames_at(tmp_path)
    assert review.page(None, 10).frames == [] and review.keep(b"one", ANSWER, SETTING)
    assert len(list(tmp_path.glob(f"{FILE}.damaged-*"))) == 1
    review.close()


def test_frames_of_another_map_are_not_shown(tmp_path: Path) -> None:
    """Two maps whose files change places, as a careless restore may do it."""
    atlas = Directory(tmp_path / "data")
    for name in ("lab", "hall"):
        review = atlas.create(name, ENCODER, 8, MapSettings(review=SETTING)).review
        assert review.keep(f"a frame of {name}".encode(), ANSWER, SETTING)
        assert atlas.verify(name).ok
    atlas.close()
    lab, hall, aside = (tmp_path / "data" / "maps" / name for name in ("lab", "hall", "aside"))
    for source, target in ((lab, aside), (hall, lab), (aside, hall)):
        target.mkdir(exist_ok=True)
        (source / FILE).rename(target / FILE)
    aside.rmdir()
    atlas = Directory(tmp_path / "data")
    report = atlas.verify("lab")
    assert not report.ok and report.problems == [f"{FILE}: it belongs to the map 'hall'"]
    for name, folder in (("lab", lab), ("hall", hall)):
        review = atlas.get(name).review
        assert review.page(None, 10) == StoredReviews([], 0, 0)
        assert review.keep(b"new", ANSWER, SETTING) and atlas.verify(name).ok
        assert len(list(folder.glob(f"{FILE}.damaged-*"))) == 1
    atlas.close()


@pytest.mark.parametrize("statement", ["DROP TABLE review_map", "DELETE FROM review_map"])
def test_a_file_that_names_no_map_yet_is_taken(tmp_path: Path, statement: str) -> None:
    """Of an earlier version, or of a crash right after it was made."""
    review = frames_at(tmp_path)
    review.keep(b"one", ANSWER, SETTING)
    review.close()
    edit(tmp_path / FILE, statement)
    if statement.startswith("DROP"):
        edit(tmp_path / FILE, "PRAGMA user_version = 2")
    assert frames_at(tmp_path).check() == ([], 3)
    review = frames_at(tmp_path)
    assert review.page(None, 10).count == 1
    review.close()
    other = ReviewFrames(tmp_path / FILE, "hall", lambda: None)
    assert other.check() == ([f"{FILE}: it belongs to the map 'lab'"], 3)


def test_verify_reads_the_frames(tmp_path: Path) -> None:
    """In service and out of it; nothing is mended by looking."""
    atlas = Directory(tmp_path / "data")
    map_ = atlas.create("lab", ENCODER, 8, MapSettings(review=SETTING))
    for number in range(4):
        assert map_.review.keep(bytes([number]) * 100, ANSWER, SETTING)
    assert atlas.verify("lab").checked_bytes >= 400
    atlas.close()
    path = tmp_path / "data" / "maps" / "lab" / FILE
    edit(path, "UPDATE review_frames SET answer = replace(answer, 'unknown', 'unknowm') WHERE number = 1")
    edit(path, "UPDATE review_pictures SET bytes = x'FF' WHERE number = 2")
    edit(path, "DELETE FROM review_pictures WHERE number = 3")
    found = [
        f"{FILE}: frame 1 does not match its checksum",
        *(f"{FILE}: the picture of frame {number} does not match its digest" for number in (2, 3)),
    ]
    atlas = Directory(tmp_path / "data")
    assert atlas.verify("lab").problems == atlas.verify("lab").problems == found
    assert inspect_folder(path.parent).problems == found
    atlas.close()
    path.write_bytes(b"no database at all" * 100)
    (problem,) = inspect_folder(path.parent).problems
    assert problem.startswith(FILE) and path.read_bytes()[:2] == b"no"


def test_kept_frames_go_with_their_map(tmp_path: Path) -> None:
    atlas = Directory(tmp_path / "data")
    map_ = atlas.create("lab", ENCODER, 8, MapSettings(review=SETTING))
    assert map_.review.keep(b"one", ANSWER, SETTING)
    folder = tmp_path / "data" / "maps" / "lab"
    assert (folder / FILE).is_file() and atlas.verify("lab").ok
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
