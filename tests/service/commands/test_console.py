"""The output of commands: texts of others are shown as they are, and drive no terminal."""

from __future__ import annotations

import json

import pytest

from service.commands.console import complain, json_text, printable, progress, remark, say, show, table

HOSTILE = "[/oops]\x1b]0;title\x07\x9b2J\u202eright\u2066\ud800\U000e0041"
SHOWN = r"[/oops]\u001b]0;title\u0007\u009b2J\u202eright\u2066\ud800\udb40\udc41"


def test_texts_of_others_in_every_kind_of_output(capsys: pytest.CaptureFixture[str]) -> None:
    """Sentences, tables with their titles and headings, and progress bars."""
    say(HOSTILE)
    remark(HOSTILE)
    complain(HOSTILE)
    rows = table(HOSTILE, f"#{HOSTILE}", title=HOSTILE)
    rows.add_row(HOSTILE, HOSTILE)
    show(rows)
    with progress() as bar:
        bar.add_task("\x1b\u202e", total=1)  # a longer one would be cut
    written = capsys.readouterr()
    assert (written.out.count(SHOWN), written.err.count(SHOWN)) == (6, 2)
    assert "\\u001b\\u202e" in written.err.splitlines()[-1]
    assert not set(HOSTILE) - set(SHOWN) & set(written.out + written.err)


def test_json_for_a_terminal_is_the_same_value() -> None:
    value = {HOSTILE: ["\u00e4\U0001f600", "line\n\ttab"]}
    text = json_text(value)
    assert json.loads(text) == value and "\u00e4\U0001f600" in text
    assert not set(HOSTILE) - set(SHOWN) & set(text)


@pytest.mark.parametrize(
    "text",
    [
        "Gr\u00fc\u00dfe, \u4e2d\u6587, \u0627\u0644\u0639\u0631\u0628\u064a\u0629",
        "\u0915\u094d\u200d\u0937 \U0001f468\u200d\U0001f33e",  # joined letters and a joined picture
        "a\tb\nc",
    ],
)
def test_texts_that_people_write_stay_as_they_are(text: str) -> None:
    assert printable(text) == text
