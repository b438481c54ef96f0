"""Reads what a child process would read, without one: a child takes half a second, and some tests read hundreds."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Literal

import pytest

from core.errors import InvalidModel
from lab.conversion.isolation import Contents, convert, first_bytes


def read_here(module: str, path: Path, *arguments: str, framework: Literal["pt", "numpy"], room: int = 0) -> Contents:
    """What ``read_in_child`` gives, of a file that neither crashes the library nor takes much memory."""
    first_bytes(path, 1)
    reader = sys.modules[module]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "contents"
        try:
            convert(reader._read, reader.save_file, path, target, *arguments)
        except InvalidModel as error:
            raise InvalidModel(f"{path.name} cannot be used: {error}") from error
        return Contents(target, framework)


def use(monkeypatch: pytest.MonkeyPatch, module: str) -> None:
    """Let a reader read in this process."""
    monkeypatch.setattr(sys.modules[module], "read_in_child", read_here)
