"""What can be a name: of a map, a place, a sequence, a camera, an encoder, a key, and of whatever else is given one.

Names stand in paths, which clients, proxies and browsers put in order before a request is sent: a segment ``..`` goes,
and takes the one before it along.  They also stand in tables and logs, where an invisible character makes two names
look the same, or turns the line around.  So no name is ``.`` or ``..``, and none has a slash or such a character.

A name is either a *text* in any script, or a *word* of ASCII that begins with a letter or a digit, which no text can
look like.  Both are patterns without anchors and without assertions, which JSON Schema and Rust can read as well.
"""

from __future__ import annotations

import re

from core.errors import InvalidIdentifier

UNSEEN = r"\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"
"""The inside of a character class: controls (C0, DEL, C1), ends of lines and paragraphs, and marks of direction."""

TEXT = rf"(\.{{0,2}}[^./{UNSEEN}]|\.{{3}})[^/{UNSEEN}]*"
"""Any text that has neither a slash nor an unseen character, and is not ``.`` or ``..``."""

LONGEST = 128
"""Characters of the longest name."""


def word(most: int, more: str = "~") -> str:
    """The pattern of a word of 1 to ``most`` characters: ASCII letters, digits, ``._-``, and ``more``."""
    return rf"[A-Za-z0-9][A-Za-z0-9._{more}-]{{0,{most - 1}}}"


def check_name(text: str, kind: str) -> str:
    """Return ``text`` if it can be a name.

    Args:
        kind: what it is to name, with its article, for the message.

    Raises:
        InvalidIdentifier: it cannot.
    """
    if len(text) > LONGEST or not re.fullmatch(TEXT, text):
        raise InvalidIdentifier(
            f"{text[:140]!a} cannot name {kind}: a name has 1 to {LONGEST} characters, no slash, no control characters "
            "and no marks of direction, and is not '.' or '..'."
        )
    return text
