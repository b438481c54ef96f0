"""The preferred form of an answer, entity tags, conditions and ranges of bytes."""

from __future__ import annotations

import pytest

from core.errors import RevisionMismatch
from service.errors.faults import ExportGone, RangeNotSatisfiable
from service.http.headers import (
    Slice,
    check_match,
    entity_tag,
    expected_revision,
    is_known,
    named_tags,
    preferred,
    wanted_slice,
)


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        (None, "application/json"),
        ("", "application/json"),
        ("*/*", "application/json"),
        ("image/png", "image/png"),
        ("image/*", "image/png"),
        ("application/json, image/png", "application/json"),
        ("application/json;q=0.5, image/png", "image/png"),
        ("image/png;q=0.2, */*;q=0.9", "application/json"),
        ("image/png;q=0", "application/json"),
        ("text/html", "application/json"),
        ("IMAGE/PNG; q=nonsense", "application/json"),
        ("image/png; q=1.0 , application/json;q=0.9", "image/png"),
    ],
)
def test_the_preferred_media_type(accept: str | None, chosen: str) -> None:
    assert preferred(accept, "application/json", "image/png") == chosen


@pytest.mark.parametrize(
    ("if_match", "expected"), [(None, None), ("*", None), ('"7"', 7), ('"3", "7"', 7), (f"{entity_tag(7)} ", 7)]
)
def test_the_revision_that_an_edit_requires(if_match: str | None, expected: int | None) -> None:
    assert expected_revision(if_match, 7) == expected


@pytest.mark.parametrize("if_match", ['"6"', 'W/"7"', "7", ""])
def test_an_edit_of_another_revision_is_refused(if_match: str) -> None:
    with pytest.raises(RevisionMismatch, match="revision 7"):
        expected_revision(if_match, 7)


@pytest.mark.parametrize(
    ("header", "start", "stop"),
    [
        ("bytes=0-", 0, 100), ("bytes=0-0", 0, 1), ("bytes=10-19", 10, 20), ("bytes=90-1000", 90, 100),
        ("bytes=-10", 90, 100), ("bytes=-1000", 0, 100), ("BYTES=5-6", 5, 7), ("bytes= 99-", 99, 100),
        # Whatever cannot be read, or is more than one range, is passed over.
        ("", 0, 100), ("bytes=", 0, 100), ("bytes=-", 0, 100), ("bytes=5-4", 0, 100), ("bytes=0-1,5-6", 0, 100),
        ("lines=1-2", 0, 100), ("bytes=a-b", 0, 100), ("bytes=1-2-3", 0, 100), ("bytes=" + "9" * 400 + "-", 0, 100),
    ],
)  # fmt: skip
def test_ranges(header: str, start: int, stop: int) -> None:
    part = wanted_slice({"range": header}, "t", 100)
    assert part == Slice(start, stop, 100)
    assert part.is_whole == ((start, stop) == (0, 100))
    if header == "bytes=10-19":
        assert part.content_range == "bytes 10-19/100"


@pytest.mark.parametrize("header", ["bytes=100-", "bytes=100-200", "bytes=-0"])
def test_a_range_behind_the_end(header: str) -> None:
    with pytest.raises(RangeNotSatisfiable) as refused:
        wanted_slice({"range": header}, "t", 100)
    assert refused.value.headers == {"Content-Range": "bytes */100"}


@pytest.mark.parametrize(
    ("condition", "given"), [('"t"', True), ('"u"', False), ('W/"t"', False), ("Sat, 21 Nov 2026 10:00:00 GMT", False)]
)
def test_if_range(condition: str, given: bool) -> None:
    part = wanted_slice({"range": "bytes=5-", "if-range": condition}, "t", 100)
    assert part.is_whole is not given


def test_conditions() -> None:
    check_match({}, "t")
    check_match({"if-match": '"u", "t"'}, "t")
    check_match({"if-match": "*"}, "t")
    with pytest.raises(ExportGone):
        check_match({"if-match": 'W/"t"'}, "t")
    assert is_known({"if-none-match": 'W/"t"'}, "t") and is_known({"if-none-match": "*"}, "t")
    assert not is_known({}, "t") and not is_known({"if-none-match": '"u"'}, "t")
    assert named_tags({"if-match": '"a", W/"b"', "if-range": '"c"'}) == ["a", "c"]
