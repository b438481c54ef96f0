"""Every figure of the benchmarks and of the README is measured by a part of ``benchmarks.all``."""

from __future__ import annotations

import re

import pytest

from benchmarks.all import PARTS
from tests.project.sources import ROOT

PAGE = (ROOT / "docs/benchmarks.md").read_text()
README = (ROOT / "README.md").read_text().partition("\n## Figures\n")[2].partition("\n## ")[0]
IN_SHORT = PAGE.partition("\n## In short\n")[2].partition("\n## ")[0]
SECTIONS = re.split(r"^##+ ", PAGE, flags=re.MULTILINE)[1:]
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)

PUBLISHED = "AMOSNet"
"""In the one table of figures of others, from matrices that its text names."""

ROWS = {
    # In short
    "accuracy": ("corridor", "maps"),
    "best other system": ("corridor",),
    "a run with sessions": ("runs",),
    "recognized rightly after a year": ("learning",),
    "a query, one robot": ("service",),
    "sixteen robots": ("service",),
    "enrolment": ("enrolment",),
    "memory with": ("start",),
    "disk": ("search",),
    "a million places": ("million",),
    "1 400 kills": ("crashes", "server-crashes", "power"),
    # README
    "encode a": ("encoding",),
    "query over HTTP": ("service",),
    "4 and 16 robots": ("service",),
    "search of": ("search", "million"),
    "corridor, recall@1": ("corridor",),
    "the same, means": ("stages",),
    "lip6, recall@1": ("maps", "runs"),
    "corridor, lip6": ("maps",),
    "nordland_tiny": ("runs",),
    "strangers": ("maps",),
    "one place on disk": ("search",),
}
"""The parts that measure a row of a summary, by how the row begins."""


def rows(text: str) -> list[str]:
    """The first cells of tables, without heads and rules."""
    found = [line.strip("| ").split(" | ")[0] for table in TABLE.findall(text) for line in table.splitlines()[2:]]
    assert found
    return found


def parts_of(text: str) -> set[str]:
    return {name for name in re.findall(r"`([a-z0-9-]+)`", text) if name in PARTS}


@pytest.mark.parametrize("text", [IN_SHORT, README], ids=["in short", "README"])
def test_every_row_of_a_summary_is_measured_by_a_part(text: str) -> None:
    for row in rows(text):
        begins = [beginning for beginning in ROWS if row.startswith(beginning)]
        assert begins, f"no part is known that measures: {row}"
        assert set(ROWS[max(begins, key=len)]) <= set(PARTS)


def test_every_row_that_is_known_is_there() -> None:
    found = rows(IN_SHORT) + rows(README)
    assert [beginning for beginning in ROWS if not any(row.startswith(beginning) for row in found)] == []


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.partition("\n")[0])
def test_every_table_names_the_part_that_measures_it(section: str) -> None:
    if section.startswith("In short"):
        return
    for match in TABLE.finditer(section):
        table = match[0]
        if PUBLISHED in table and "FAB-MAP" not in table:
            assert "VPR-Bench publishes" in section
        elif "| part |" in table.splitlines()[0]:
            for line in table.splitlines()[2:]:
                last = line.strip("| \n").split(" | ")[-1]
                assert last == "the same" or parts_of(last), line
        else:
            assert parts_of(section.replace(table, "")), f"no part is named beside {table.splitlines()[0]}"


def test_no_other_command_measures_a_figure() -> None:
    """It would be left out when all are measured again."""
    for section in SECTIONS:
        title, _, text = section.partition("\n")
        if title != "Measure again":
            others = re.findall(r"`(?:python -m|scripts/(?:soak|fuzz|test)|pytest)[^`]*`", text)
            assert others == [], title
