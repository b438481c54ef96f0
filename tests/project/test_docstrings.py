"""A docstring begins with a noun or a verb, never with a headless relative clause ("What a map holds")."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.project.sources import FILES, ROOT, syntax_of

HEADLESS = re.compile(r"(What|Whose|Of which|That which)\s")

ROOMS = ("core", "service", "lab", "benchmarks", "clients", "examples", "scripts")


def headless(path: Path) -> list[str]:
    """The first lines of a file's docstrings, those of attributes included, that begin without a noun or a verb."""
    texts = (
        node.value.value
        for node in ast.walk(syntax_of(path))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    )
    return [text.splitlines()[0] for text in texts if HEADLESS.match(text)]


def test_a_headless_docstring_is_found(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text('"""What-if analysis."""\nMOST = 3\n"""Whose rows are read."""\n\n\ndef f(): "What it does."\n')
    assert headless(module) == ["Whose rows are read.", "What it does."]


@pytest.mark.parametrize("room", ROOMS)
def test_docstrings_begin_with_a_noun_or_a_verb(room: str) -> None:
    files = [path for path in FILES if path.is_relative_to(ROOT / room)]
    assert files
    assert [f"{path.relative_to(ROOT)}: {line}" for path in files for line in headless(path)] == []
