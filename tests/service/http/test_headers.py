"""The preferred form of an answer, entity tags and conditions."""

from __future__ import annotations

import pytest

from core.errors import RevisionMismatch
from service.errors.faults import ExportGone
from service.http.headers import check_match, entity_tag, expected_revision, is_known, named_tags, preferred


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


def test_conditions() -> None:
    check_match({}, "t")
    check_match({"if-match": '"u", "t"'}, "t")
    check_match({"if-match": "*"}, "t")
    with pytest.raises(ExportGone):
        check_match({"if-match": 'W/"t"'}, "t")
    assert is_known({"if-none-match": 'W/"t"'}, "t") and is_known({"if-none-match": "*"}, "t")
    assert not is_known({}, "t") and not is_known({"if-none-match": '"u"'}, "t")
    assert named_tags({"if-match": '"a", W/"b"', "if-range": '"c"'}) == ["a", "c"]
