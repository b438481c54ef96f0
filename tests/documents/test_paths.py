"""The paths of a query and of an enrolment, as the page on architecture tells them, are those of the code."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
ROW = re.compile(r"^\| `((?:core|service)/[\w/]+\.py)` \| (.+) \|$", re.MULTILINE)
MOST_FILES = 30


def rows_of(heading: str) -> list[tuple[str, str]]:
    """Files and what happens there, of the section with a heading."""
    return ROW.findall(PAGE.partition(f"\n## {heading}\n")[2].partition("\n## ")[0])


QUERY, ENROLMENT = rows_of("The path of a query"), rows_of("The path of an enrolment")


def test_a_query_passes_few_files() -> None:
    files = [file for file, _ in QUERY]
    assert 15 < len(files) == len(set(files)) <= MOST_FILES
    assert files[0].startswith("service/http/") and files[-1].startswith("service/queries/")


@pytest.mark.parametrize(("file", "text"), [*QUERY, *ENROLMENT])
def test_what_a_row_names_is_in_its_file(file: str, text: str) -> None:
    tree = ast.parse((ROOT / file).read_text())
    defined = {
        node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
    }
    named = [name.rpartition(".")[2] for name in re.findall(r"`([A-Za-z_.]+)`", text)]
    own = named[0] if named else ""
    assert not own or own in defined, f"{file} has no {own}"
