"""What can be a name, told again by what Unicode says of its characters, and what becomes of names in a URL."""

from __future__ import annotations

import posixpath
import re
import unicodedata
from typing import Annotated
from urllib.parse import quote, unquote

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from core.errors import InvalidIdentifier
from core.names import LONGEST, TEXT, Names, composed, texts, word
from core.networks.network import NAMES as NETWORK_NAMES
from core.places import (
    CAMERAS,
    MAP_ID,
    MAP_IDS,
    PLACE_ID,
    PLACE_IDS,
    SEQUENCES,
    Camera,
    Sequence,
    check_map_id,
    check_place_id,
    check_sequence,
)

FILLERS = "\u115f\u1160\u2800\u3164\uffa0"
JOINERS = {"\u200c", "\u200d"}
SEEN = {*map(chr, range(0x600, 0x606)), "\u06dd", "\u070f", "\u0890", "\u0891", "\u08e2"}
SEEN_BEYOND = {chr(point) for point in range(0x10000, 0xE0000) if unicodedata.category(chr(point)) == "Cf"}
"""Signs that are drawn, of the category Cf: of Arabic and Syriac; beyond U+FFFF also of shorthand and of music."""
ODD = (
    "./\\%2eE \u2003\u3164"
    "\n\r\0\x7f\x80\x9f\xad\u061c\u200b\u200d\u200e\u2028\u2029\u202e\u2066\u2069\ufeff\U000e0041\ud800üА日💡"
)
SEQUENCE: TypeAdapter[str] = TypeAdapter(Sequence)
WORDS = (MAP_ID, PLACE_ID, NETWORK_NAMES.pattern, word(64), word(64, more="@"))


def can_be(text: str) -> bool:
    dots = unquote(text) in (".", "..")
    blank = not text.startswith("...") and text.lstrip(".")[:1].isspace()
    return not blank and 0 < len(text) <= LONGEST and not dots and not any(map(cannot_be_in, text))


def cannot_be_in(letter: str) -> bool:
    unseen = unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Zl", "Zp")
    return letter in "/\\" or letter in FILLERS or (unseen and letter not in JOINERS | SEEN | SEEN_BEYOND)


def taken(text: str) -> bool:
    """Whether a text passes, which the function and the model agree on."""
    try:
        check_sequence(text)
        passes = True
    except InvalidIdentifier:
        passes = False
    try:
        SEQUENCE.validate_python(text)
    except ValidationError:
        assert not passes
    else:
        assert passes
    return passes


@pytest.mark.thorough
@given(st.one_of(st.text(max_size=LONGEST + 2), st.text(ODD, max_size=5), st.from_regex(TEXT, fullmatch=True)))
def test_a_name_is_what_can_be_read_and_stands_in_a_path(text: str) -> None:
    assert taken(text) == can_be(unicodedata.normalize("NFC", text))


@pytest.mark.parametrize("letter", [chr(point) for point in range(0x3200) if cannot_be_in(chr(point))], ids=ascii)
def test_no_name_has_an_unseen_character(letter: str) -> None:
    for text in (letter, f"a{letter}", f"{letter}a", f"a{letter}b", f"..{letter}", f"...{letter}"):
        assert not taken(text)


@given(st.text(max_size=20))
def test_a_name_has_one_form(text: str) -> None:
    for form in ("NFC", "NFD"):
        spelled = unicodedata.normalize(form, text)
        if taken(spelled):
            assert check_sequence(spelled) == SEQUENCE.validate_python(spelled) == unicodedata.normalize("NFC", text)


def test_texts_of_json_have_one_form_with_their_names() -> None:
    apart = unicodedata.normalize("NFD", "é")
    assert composed({apart: [apart, 1, None, {"a": apart}], "b": True}) == {"é": ["é", 1, None, {"a": "é"}], "b": True}
    with pytest.raises(ValueError, match="differ in nothing that can be seen"):
        composed([{apart: 1, "é": 2}])


def test_dots_are_names_only_from_three_on() -> None:
    assert [taken("." * count) for count in range(5)] == [False, False, False, True, True]
    assert all(map(taken, (".a", "..a", "a..", "a.", "a", "a ", "... ", ".%", "…", "x" * LONGEST)))
    assert not any(map(taken, (" ", "\u2003", " a", ". ", "..\u00a0")))
    assert not taken("x" * (LONGEST + 1))


@given(st.from_regex(TEXT, fullmatch=True))
def test_a_path_keeps_a_name_whatever_normalizes_it(text: str) -> None:
    path = f"/v1/maps/lab/sequences/{quote(text, safe='')}"
    assert httpx.URL(f"http://robot{path}").raw_path.decode() == path == posixpath.normpath(path)


@pytest.mark.thorough
@pytest.mark.parametrize("pattern", WORDS)
def test_a_word_is_a_text(pattern: str) -> None:
    @given(st.from_regex(pattern, fullmatch=True))
    def is_text(name: str) -> None:
        assert can_be(name) and taken(name)

    is_text()
    assert not any(re.fullmatch(pattern, one) for one in ("", ".", "..", "a/b", "%2e%2e", "\n", "a\n", "\u202e"))


def test_ids_and_cameras_follow_the_rule() -> None:
    for name in ("", ".", "..", "a/b", "%2e%2e", "a\n", "\u202e", "a\u2066b"):
        for check in (check_map_id, check_place_id):
            with pytest.raises(InvalidIdentifier):
                check(name)
        with pytest.raises(ValidationError):
            TypeAdapter(Camera).validate_python(name)


def test_the_message_shows_what_is_unseen() -> None:
    with pytest.raises(InvalidIdentifier, match=r"^'a\\u202eb' cannot name a lamp: .* is not '\.' or '\.\.', however"):
        texts("a lamp").check("a\u202eb")


@pytest.mark.parametrize("kind", [MAP_IDS, PLACE_IDS, SEQUENCES, CAMERAS, NETWORK_NAMES], ids=lambda kind: kind.what)
@pytest.mark.parametrize("text", ["", "..", "a/b", "\n", "x" * 129])
def test_a_field_is_refused_with_the_sentence_of_an_argument(kind: Names, text: str) -> None:
    with pytest.raises(InvalidIdentifier) as refused:
        kind.check(text)
    assert kind.what in str(refused.value) and " has 1 to " in str(refused.value) and "[" not in str(refused.value)
    with pytest.raises(ValidationError) as invalid:
        TypeAdapter(Annotated[str, kind]).validate_python(text)
    assert invalid.value.errors()[0]["msg"] == f"Value error, {refused.value}"


def test_the_schema_has_the_pattern() -> None:
    assert SEQUENCE.json_schema() == {"type": "string", "minLength": 1, "maxLength": 128, "pattern": f"^{TEXT}$"}
    assert TypeAdapter(Camera).json_schema() == {"type": "string", "pattern": f"^{word(64)}$"}
