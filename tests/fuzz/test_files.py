"""Damaged files of every kind: a short run of what ``scripts/fuzz files`` does; ``scripts/test --all`` runs a minute of
each kind.
"""

from __future__ import annotations

import math
import os
import signal
from itertools import count
from pathlib import Path

import pytest

from tests.fuzz.files import KINDS, run

SECONDS = float(os.environ.get("FUZZ_SECONDS", "0"))
"""For each kind; 0: a few files."""

FEW = 25


@pytest.mark.thorough
@pytest.mark.timeout(600 + 2 * SECONDS)
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_read_or_refused(kind: str, tmp_path: Path) -> None:
    few = not SECONDS
    report = run(kind, 1, iter(range(FEW)) if few else count(), math.inf if few else SECONDS, tmp_path)
    assert report.wrong == [] and sum(report.ends.values()) >= (FEW if few else 1)


def test_the_same_number_gives_the_same_bytes(tmp_path: Path) -> None:
    for number in (3, 3):
        report = run("cursors", 5, iter([number]), math.inf, tmp_path)
        assert report.wrong == []


def test_what_is_wrong_is_found_and_its_file_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that raises another error, takes too much memory, or ends its process."""

    def fail(_path: Path) -> None:
        raise KeyError("unforeseen")

    def grow(_path: Path) -> None:
        bytearray(1 << 34)

    def end(_path: Path) -> None:
        if "damaged" in _path.name:
            os.kill(os.getpid(), signal.SIGKILL)

    for name, read, why in (("fails", fail, "unforeseen"), ("grows", grow, "memory"), ("ends", end, "signal 9")):
        sound = KINDS["cursors"]
        monkeypatch.setitem(KINDS, name, type(sound)(sound.write, read))
        monkeypatch.setattr("tests.fuzz.files._sound", lambda *_: None)
        report = run(name, 0, iter(range(2)), math.inf, tmp_path / name)
        assert len(report.wrong) == 2 and all(why in one for one in report.wrong), report
        assert len(list((tmp_path / name).iterdir())) == 2
