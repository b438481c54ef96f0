"""Nothing is acknowledged before all that was written for it is synced, files and folders."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.syscalls import audit, is_marker, strace, strace_arguments

REPOSITORY = Path(__file__).parents[4]


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Of a process that does every kind of write, and its data directory."""
    if strace() is None:
        pytest.skip("strace is not installed, or may not trace here")
    folder = tmp_path_factory.mktemp("synced").resolve()
    command = [sys.executable, "-m", "tests.core.store.worker", "everything", str(folder / "data")]
    traced = [*strace_arguments(folder / "trace"), *command]
    subprocess.run(traced, cwd=REPOSITORY, check=True, capture_output=True, timeout=300)
    return (folder / "trace").read_text(), folder / "data"


@pytest.mark.thorough
def test_every_write_is_synced_before_it_is_acknowledged(trace: tuple[str, Path]) -> None:
    report = audit(*trace, is_marker)

    assert report.violations == []
    assert report.acknowledgements > 300
    assert report.syncs > 300
    assert report.writes > 300


def test_descriptors_are_synced_before_the_commit_that_names_them(trace: tuple[str, Path]) -> None:
    def is_commit(call: str) -> bool:
        """SQLite syncs its log: from then on what the log names may be found after a crash."""
        return call.startswith("fdatasync(") and "map.sqlite-wal>" in call

    def is_no_descriptor(path: str) -> bool:
        return Path(path).suffix not in ("", ".seg")

    text, directory = trace
    report = audit(text, directory / "maps" / "lab", is_commit, is_ignored=is_no_descriptor)

    assert report.violations == []
    assert report.acknowledgements > 300
    assert report.writes >= 6
