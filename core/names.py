"""The rules of names: of maps, places, sequences, cameras, encoders, keys, and everything else that has a name.

Names stand in paths, which clients, proxies and browsers put in order before a request is sent: a segment ``..`` goes,
and takes the one before it along.  They also stand in tables and logs, where an invisible character makes two names
look the same, or turns the line around.  So no name is ``.`` or ``..``, also where a path is written with ``%2e``, and
none has a slash, a backslash, which browsers take for one, or such a character.

A name is either a *text* in any script, or a *word* of ASCII that begins with a letter or a digit, which no text can
look like.  Both are patterns without anchors and without assertions, which JSON Schema and Rust can read as well.

A text has one form, the composed one of Unicode (NFC), in which keyboards write: some systems take file names apart
(``e`` and an accent behind it), and two names that look the same would be two.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, GetCoreSchemaHandler, GetJsonSchemaHandler

from core.errors import InvalidIdentifier

UNSEEN = (
    r"\x00-\x1f\x7f-\x9f\xad\u061c\u115f\u1160\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\u2800\u3164\ufeff"
    r"\uffa0\ufff9-\ufffb"
)
"""The inside of a character class: controls (C0, DEL, C1), ends of lines and paragraphs, marks of direction, what takes
no room, and what fills room that looks empty (of Hangul and Braille).  The two joiners (U+200C, U+200D) are allowed,
for they change how letters of some scripts look."""

_NONE_OF = rf"/\\{UNSEEN}"

TEXT = rf"(\.{{0,2}}[^.\s{_NONE_OF}]|\.{{3}})[^{_NONE_OF}]*"
"""Any text that has neither a slash, nor a backslash, nor an unseen character, is not ``.`` or ``..``, and does not
begin with a space, also behind these, so that it is not empty for those who look."""

_NO_NAME = re.compile(r"(\.|%2e){1,2}|.*[\ud800-\udfff\U000e0001\U000e0020-\U000e007f].*", re.IGNORECASE | re.DOTALL)
"""Texts that fit the pattern and are no names: the dots of a path, surrogates, and invisible tags."""

LONGEST = 128
"""Characters of the longest name."""


Value = TypeVar("Value")


def composed(value: Value) -> Value:
    """A text in its one form (NFC); of an object or a list as JSON has them, all texts and all names in it.

    Raises:
        ValueError: two names of an object are one in this form.
    """
    made: Any = value
    if isinstance(value, str):
        made = unicodedata.normalize("NFC", value)
    elif isinstance(value, list):
        made = [composed(one) for one in value]
    elif isinstance(value, dict):
        made = {composed(name): composed(one) for name, one in value.items()}
        if len(made) < len(value):
            raise ValueError("two names of an object differ in nothing that can be seen")
    return made


def spellings(text: str) -> list[str]:
    """The forms in which a text may have been stored before there was one form, this one first."""
    return list(dict.fromkeys((text, unicodedata.normalize("NFD", text))))


def word(most: int, more: str = "~") -> str:
    """The pattern of a word of 1 to ``most`` characters: ASCII letters, digits, ``._-``, and ``more``."""
    return rf"[A-Za-z0-9][A-Za-z0-9._{more}-]{{0,{most - 1}}}"


@dataclass(frozen=True)
class Names:
    """The rule of names of one kind: for code, and as a mark of a model's field, ``Annotated[str, names]``.

    A field that is no name is refused with the same sentence as an argument; the JSON Schema has the pattern.

    what: the named thing, with its article.
    pattern: of every name, without anchors.
    rule: the pattern in words that go on after "a name".
    most: characters of the longest one; None: the pattern says it.
    but: a text of the pattern that is no name all the same; the schema does not say so.
    """

    what: str
    pattern: str
    rule: str
    most: int | None = None
    but: str | None = None

    def check(self, text: str) -> str:
        """Return ``text`` in its one form if it can be a name.

        Raises:
            InvalidIdentifier: it cannot.
        """
        text = composed(text)
        too_long = self.most is not None and len(text) > self.most
        if too_long or text == self.but or _NO_NAME.fullmatch(text) or not re.fullmatch(self.pattern, text):
            raise InvalidIdentifier(f"{text[:140]!a} cannot name {self.what}: a name {self.rule}.")
        return text

    def _check_field(self, text: str) -> str:
        try:
            return self.check(text)
        except InvalidIdentifier as error:
            raise ValueError(str(error)) from error

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler(Annotated[source, AfterValidator(self._check_field)])

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        lengths = {} if self.most is None else {"minLength": 1, "maxLength": self.most}
        return {**handler(schema), **lengths, "pattern": f"^{self.pattern}$"}


def texts(what: str, most: int = LONGEST) -> Names:
    """Names that are texts, of 1 to ``most`` characters."""
    rule = (
        f"has 1 to {most} characters, no slash or backslash, no characters that cannot be seen, "
        "no space at its beginning, and is not '.' or '..', however they are written"
    )
    return Names(what, TEXT, rule, most)


def words(what: str, most: int, more: str = "~") -> Names:
    """Names that are words; ``most`` and ``more`` as of ``word``."""
    return Names(what, word(most, more), rule_of_words(most, f". _ {more} -"))


def file_names(what: str, but: str | None = None) -> Names:
    """Names of what is a file or a folder: words of 1 to 64 characters without capital letters; ``but`` as of Names."""
    rule = rule_of_words(64, ". _ -", "small letters") + ("" if but is None else f", and is not {but!r}")
    return Names(what, r"[a-z0-9][a-z0-9._-]{0,63}", rule, but=but)


def rule_of_words(most: int, marks: str, letters: str = "letters") -> str:
    """The rule of a word as a sentence for people."""
    return f"has 1 to {most} characters: {letters} of ASCII, digits and {marks}, and begins with a letter or a digit"
