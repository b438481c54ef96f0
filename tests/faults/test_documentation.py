"""The table of faults in docs/faults.md names every test here, one a row."""

from __future__ import annotations

import ast
import re
from pathlib import Path

FOLDER = Path(__file__).parent
PAGE = FOLDER.parents[1] / "docs" / "reference" / "faults.md"


def injecting() -> set[str]:
    """All tests of this folder, as the table names them."""
    return {
        f"{path.name}::{node.name}"
        for path in FOLDER.glob("test_*.py")
        if path != Path(__file__)
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_every_row_is_a_test_and_every_test_a_row() -> None:
    table = PAGE.read_text().partition("\n## ")[0]
    rows = [line for line in table.splitlines() if line.startswith("|")][2:]
    named = [re.findall(r"`(test_\w+\.py::test_\w+)`", row.rpartition("|")[0].rpartition("|")[2]) for row in rows]
    assert all(len(names) == 1 for names in named), "each row names one test"
    listed = [name for (name,) in named]
    assert len(listed) == len(set(listed))
    assert set(listed) == injecting()
