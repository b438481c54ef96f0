"""A disk that fails while it syncs: what it holds is unknown then, and must be made certain before the next write."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from core.store import Directory
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame, local_of, stored_of
from tests.syscalls import strace

REPOSITORY = Path(__file__).parents[3]

pytestmark = pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")


def run(action: str, directory: Path, call: str, error: str, when: str) -> subprocess.CompletedProcess[bytes]:
    """The worker, whose calls fail as strace lets them fail."""
    inject = ["-e", f"trace={call}", "-e", f"inject={call}:error={error}:when={when}"]
    command = [sys.executable, "-m", "tests.core.store.worker", action, str(directory)]
    traced = [strace() or "", "-f", "--seccomp-bpf", "-o", "/dev/null", *inject, *command]
    return subprocess.run(traced, cwd=REPOSITORY, capture_output=True, timeout=300, check=False)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("call", "error", "when"),
    [
        # Files and folders are synced with fsync, SQLite uses fdatasync.
        ("fsync", "EIO", "2"),
        ("fdatasync", "EIO", "1"),
        *[pytest.param("fsync", "EIO", when, marks=pytest.mark.thorough) for when in ("4", "5", "7", "3+2")],
        *[pytest.param("fdatasync", "EIO", when, marks=pytest.mark.thorough) for when in ("2", "3", "5", "3+3")],
        ("fsync", "ENOSPC", "4+3"),
        ("pwrite64", "ENOSPC", "20+17"),
        ("pwrite64", "EIO", "21+19"),
        ("fsync", "EIO", "3+1"),
        ("fdatasync", "EIO", "3+1"),
    ],
)
def test_what_is_refused_is_not_there_and_what_is_taken_is(directory: Path, call: str, error: str, when: str) -> None:
    atlas = Directory(directory, rows_per_segment=4)
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame(f"p{i}") for i in range(2)])
    atlas.close()

    finished = run("keep-trying", directory, call, error, when)
    assert finished.returncode == 0, finished.stderr.decode()
    answer = json.loads(finished.stdout)

    taken = [name for name, outcome in answer["outcomes"] if outcome == "taken"]
    refused = {outcome for _, outcome in answer["outcomes"]} - {"taken"}
    assert refused <= ({"StorageFull"} if error == "ENOSPC" else {"StorageFailure"}) | {"StorageFailure"}
    assert answer["found"] == ["p0", "p1", *taken]
    assert answer["searched"] == 2 + len(taken)
    assert answer["problems"] == []

    atlas = Directory(directory)
    lab = atlas.get("lab")
    assert [place.id for place in lab.places(None, 100)[0]] == ["p0", "p1", *taken]
    for row, name in enumerate(["p0", "p1", *taken]):
        (found,) = lab.snapshot().descriptors_at(np.array([row]))
        np.testing.assert_array_equal(found, stored_of(name))
        np.testing.assert_array_equal(lab.snapshot().locals_at(np.array([row]))[0], local_of(name))
    assert lab.verify().ok
    atlas.close()


@pytest.mark.thorough
@pytest.mark.parametrize("when", ["3", "4", "5"])
def test_a_commit_that_was_refused_does_not_come_back_with_a_crash(directory: Path, when: str) -> None:
    """Its frames are in SQLite's log, whole: only their sync failed."""
    atlas = Directory(directory, rows_per_segment=4)
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    atlas.close()
    finished = run("die-at-refusal", directory, "fdatasync", "EIO", when)
    assert finished.returncode in (-9, 137), finished.stderr.decode()
    taken = [line.removeprefix("ack ") for line in finished.stdout.decode().splitlines()]
    atlas = Directory(directory)
    lab = atlas.get("lab")
    assert [place.id for place in lab.places(None, 100)[0]] == taken
    assert lab.verify().ok
    atlas.close()


@pytest.mark.thorough
@pytest.mark.parametrize(("call", "before"), [("4", ["0"]), ("6", ["0", "1"])], ids=["deletion", "patch"])
def test_a_change_that_was_refused_does_not_come_true_with_a_crash(
    directory: Path, call: str, before: list[str]
) -> None:
    """A deletion, which is followed by a COMMIT of its own for what nobody needs any more, a patch."""
    atlas = Directory(directory, rows_per_segment=4)
    lab = atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    lab.enrol([frame(f"p{i}", sequence="monday" if i < 4 else "tuesday") for i in range(6)])
    atlas.close()
    finished = run("die-at-refused-change", directory, "fdatasync", "EIO", call)
    assert finished.returncode in (-9, 137), finished.stderr.decode()
    taken = [line.removeprefix("ack ") for line in finished.stdout.decode().splitlines()]
    assert taken == before
    atlas = Directory(directory)
    lab = atlas.get("lab")
    assert lab.record.description == "edited"
    assert [place.id for place in lab.places(None, 9)[0]] == [f"p{i}" for i in range(4 if "1" in taken else 0, 6)]
    assert lab.place("p4").metadata == {}
    assert lab.verify().ok
    atlas.close()
