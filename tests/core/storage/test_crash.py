"""Killed at any moment, a process has lost nothing that it acknowledged, and left nothing half done."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from core.storage import Atlas, Map, index_files, ledger
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, digest_of, local_of, stored_of
from tests.syscalls import strace

REPOSITORY = Path(__file__).parents[3]

Pictures = dict[str, str]
"""What each place shows."""


def worker(directory: Path, action: str = "enrol-for-ever") -> list[str]:
    return [sys.executable, "-m", "tests.core.storage.worker", action, str(directory)]


def outcomes(told: bytes, before: Pictures) -> tuple[Pictures, Pictures]:
    """What was acknowledged, and the same with the step that was begun but not acknowledged."""
    acknowledged, begun = dict(before), dict(before)
    for line in told.decode().splitlines(keepends=True):
        if line.endswith("\n"):
            word, _, text = line.partition(" ")
            for place_id, picture in json.loads(text).items():
                state = acknowledged if word == "ack" else begun
                if picture is None:
                    state.pop(place_id, None)
                else:
                    state[place_id] = picture
    return acknowledged, begun


def stored(lab: Map) -> Pictures:
    """What the map holds, every descriptor and digest compared byte for byte with what it must be."""
    found, cursor = {}, None
    snapshot = lab.snapshot()
    while True:
        page, cursor = lab.places(cursor, 500)
        for place in page:
            with lab._reading() as connection:
                row = ledger.expect(connection, place.id).row
            candidates = {place.id, place.id.replace("new", "again")}
            (picture,) = [name for name in candidates if digest_of(name) == lab.digest(place.id)]
            np.testing.assert_array_equal(snapshot.descriptors_at(np.array([row]))[0], stored_of(picture))
            np.testing.assert_array_equal(snapshot.locals_at(np.array([row]))[0], local_of(picture))
            assert lab.thumbnail(place.id) == f"thumbnail of {picture}".encode()
            found[place.id] = picture
        if cursor is None:
            return found


def check(directory: Path, acknowledged: Pictures, begun: Pictures) -> Pictures:
    atlas = Atlas(directory)
    try:
        assert atlas.quarantined() == {}
        lab = atlas.get("lab")
        found = stored(lab)
        assert found in (acknowledged, begun)
        deadline = time.monotonic() + 60
        while lab.index_status().state == "building":
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert lab.index_status().tier == lab.index_status().wanted
        assert stored(lab) == found
        report = lab.verify()
        assert report.ok, report.problems
        assert report.stale_caches == []
        assert len(lab.snapshot()) == len(found)
        return found
    finally:
        atlas.close()


@pytest.mark.parametrize("action", ["enrol-for-ever", "enrol-and-code-for-ever"])
def test_killed_at_random_moments_nothing_acknowledged_is_lost(
    directory: Path, action: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With codes: what is made of the rows in the background is whole or made again, too."""
    monkeypatch.setattr(index_files, "GROUP_ROWS", 8)
    moments = random.Random(2)
    known: Pictures = {}
    for _ in range(6):
        with subprocess.Popen(worker(directory, action), cwd=REPOSITORY, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            told = process.stdout.readline() + process.stdout.readline()  # the first step is begun and done
            time.sleep(moments.uniform(0, 0.4 if action == "enrol-for-ever" else 2))
            process.kill()
            told += process.stdout.read()
        acknowledged, begun = outcomes(told, known)
        known = check(directory, acknowledged, begun)
    assert len(known) >= 6


@pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")
@pytest.mark.parametrize("call", ["pwrite64", "fsync", "fdatasync", "openat"])
def test_killed_within_a_system_call_nothing_acknowledged_is_lost(directory: Path, call: str) -> None:
    """At calls that follow each other, so that every gap between two steps of a write is met."""
    Atlas(directory).close()
    atlas = Atlas(directory, rows_per_segment=4)
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    atlas.close()
    known: Pictures = {}
    # Opening files and writing to them happens while Python starts, too; those are not interesting.
    first = {"pwrite64": 12, "fsync": 2, "fdatasync": 2, "openat": 0}[call]
    for number in range(first, first + 3):
        only = ["-P", str(directory / "maps" / "lab")] if call == "openat" else []
        kill = ["-e", f"trace={call}", "-e", f"inject={call}:signal=KILL:when={number + 1}"]
        command = [strace() or "", "-f", "-o", "/dev/null", *only, *kill, *worker(directory)]
        finished = subprocess.run(command, cwd=REPOSITORY, capture_output=True, timeout=60, check=False)
        assert finished.returncode in (-9, 137), finished.stderr
        acknowledged, begun = outcomes(finished.stdout, known)
        known = check(directory, acknowledged, begun)
