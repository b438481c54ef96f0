"""One range of bytes, and the conditions under which it is given."""

from __future__ import annotations

import pytest

from service.errors.faults import ExportGone, RangeNotSatisfiable
from service.http.ranges import Slice, check_match, is_known, named_tags, wanted_slice


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
