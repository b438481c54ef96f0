from __future__ import annotations

import os

import pytest

from lab.evaluation.report.text import counted, enumerate_words, file_stems, milliseconds, number, plain, size

SPACE = "\N{NO-BREAK SPACE}"


def test_plain_is_always_text() -> None:
    assert plain("corridor, façade 走廊 🙂") == "corridor, façade 走廊 🙂"
    assert plain("a\nb\0c\u202ed") == "a\ufffdb\ufffdc\ufffdd"
    assert plain(os.fsdecode(b"\xff.png")) == "\\udcff.png"
    plain("\ud800").encode("utf-8")


def test_numbers_that_are_missing() -> None:
    assert number(None) == milliseconds(None) == "–"


@pytest.mark.parametrize(
    ("time", "text"),
    [
        (0.0056, "0.006"),
        (0.0949, "0.095"),
        (0.42, "0.42"),
        (0.996, "1.0"),
        (3.14, "3.1"),
        (9.96, "10"),
        (27.4, "27"),
        (1280.4, f"1{SPACE}280"),
    ],
)
def test_milliseconds_in_steps_that_can_matter(time: float, text: str) -> None:
    assert milliseconds(time) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (1536, "1.5 KB"),
        (9_949, "9.9 KB"),
        (9_950, "10 KB"),
        (196_608, "197 KB"),
        (999_499, "999 KB"),
        (999_500, "1.0 MB"),
        (123_000_000, "123 MB"),
    ],
)
def test_size_by_thousands(count: int, text: str) -> None:
    assert size(count) == text.replace(" ", SPACE)


def test_counted() -> None:
    assert [counted(1, "query"), counted(2, "query"), counted(0, "reference")] == [
        "1 query",
        "2 queries",
        "0 references",
    ]


def test_enumerate_words() -> None:
    assert [enumerate_words(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "",
        "a",
        "a and b",
        "a, b and c",
    ]


def test_file_stems_are_safe_and_differ() -> None:
    names = [
        "m-region-vlad",
        "SPP [1 2 3 4]",
        "../../etc/passwd",
        "走廊",
        "走",
        "a b",
        "a-b",
        "a_b",
        "a-b-2",
        "x" * 300,
    ]
    stems = file_stems(names)
    assert stems[:4] == ["m-region-vlad", "spp-1-2-3-4", "etc-passwd", "system"]
    assert len(set(stems)) == len(names)
    assert max(map(len, stems)) < 60
