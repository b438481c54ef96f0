"""ENOSPC and EIO at every write point of the storage layer: what succeeded is there, what was refused is not."""

from __future__ import annotations

import copy
import os
import random
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from core.store import Directory
from tests.faults.injection import Point, ScriptProcesses, write_points
from tests.faults.model import State, all_told
from tests.faults.script import AFTERWARDS, STEPS, Step, empty
from tests.syscalls import strace

pytestmark = pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")

SEED = int(os.environ.get("PLACEREC_FAULT_SEED", "0"))
"""Chooses the points of the short run; every failure names it."""

REFUSALS = {"StorageFull", "StorageFailure"}
FOLLOWING = {"UnknownMap", "UnknownPlace", "UnknownSequence", "KeyError", "AssertionError"}
"""Outcomes of a step that follow from an earlier refusal: a map is unknown because it was not made."""


@pytest.fixture(scope="module")
def scripts() -> Iterator[ScriptProcesses]:
    with ScriptProcesses() as scripts:
        yield scripts


@pytest.fixture(scope="module")
def points(scripts: ScriptProcesses) -> list[Point]:
    return write_points(scripts)


def possible_states(steps: Sequence[Step], outcomes: Sequence[str]) -> list[State]:
    """What the maps may hold after these outcomes: one state, and more where a refusal leaves it open.

    While the disk refuses to sync, SQLite's log may hold a commit that was refused and cannot be emptied.  In the
    process it is as if it had never been; should the map be opened anew before a write is taken, it is there, whole.
    """
    states: list[State] = [{}]
    refused: list[Step] = []
    for step, outcome in zip(steps, outcomes, strict=True):
        if step.name == "open again":
            states += [after for state in states for one in refused if (after := changed_by(one, state)) is not None]
        if outcome in REFUSALS:
            refused.append(step)
        elif outcome == "taken" and not step.of_atlas:
            refused.clear()
        changed = [after for state in states if (after := changed_by(step, state)) is not None]
        if outcome == "taken":
            states = changed
        elif outcome in REFUSALS and not step.is_whole:
            states += changed
    return states


def changed_by(step: Step, state: State) -> State | None:
    """The state after a step; None if the step cannot be done in it."""
    after = copy.deepcopy(state)
    try:
        step.effect(after)
    except KeyError:
        return None
    return after


def check(told: dict[str, Any], directory: Path, steps: Sequence[Step]) -> None:
    """No unexpected error, a state that is possible after the outcomes, and the same state after a restart."""
    assert "unexpected" not in told, told["unexpected"]
    outcomes = told["outcomes"]
    assert not [outcome for outcome in outcomes if outcome.startswith("unexpected")], outcomes
    refused = [number for number, outcome in enumerate(outcomes) if outcome in REFUSALS]
    following = [number for number, outcome in enumerate(outcomes) if outcome not in REFUSALS | {"taken"}]
    assert {outcomes[number] for number in following} <= FOLLOWING, outcomes
    assert not following or min(refused) < min(following), outcomes
    assert told["quarantined"] == {}
    allowed = possible_states(steps, outcomes)
    assert told["state"] in allowed, outcomes
    assert not any(told["problems"].values()), told["problems"]
    assert (told["last"], told["best"]) == ("taken", "afterwards")
    state = told["state"]
    state.setdefault("lab", empty())
    AFTERWARDS.effect(state)
    atlas = Directory(directory)
    try:
        assert atlas.quarantined() == {}
        assert all_told(atlas) == state
        assert all(atlas.verify(map_id).ok for map_id in state)
        assert atlas.unlisted().keys() <= {"hall"}
    finally:
        atlas.close()
    assert not list(directory.rglob("*.tmp"))
    assert not [path for path in (directory / "maps").iterdir() if path.name.startswith((".making", ".removing"))]


def inject(scripts: ScriptProcesses, folder: Path, point: Point, error: str, count: int = 1) -> None:
    """Let ``count`` calls fail from a point on, and check the result."""
    when = f"{point.number}..{point.number + count - 1}" if count > 1 else str(point.number)
    fault = f"inject={point.call}:error={error}:when={when}"
    arguments = ["-o", str(folder.with_suffix(".trace")), "-e", f"trace={point.call}", "-e", fault]
    try:
        told = scripts.run(folder, arguments)
        assert "INJECTED" in folder.with_suffix(".trace").read_text()
        check(told, folder / "data", STEPS)
    except AssertionError as error_found:
        raise AssertionError(f"seed {SEED}, {fault}: {point.text[:120]}: {error_found}") from error_found
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        folder.with_suffix(".trace").unlink(missing_ok=True)


@pytest.mark.thorough
def test_the_write_points_are_of_every_kind(points: list[Point]) -> None:
    assert {point.call for point in points} >= {
        "openat", "pwrite64", "fsync", "fdatasync", "ftruncate", "mkdir", "rename", "unlink", "mmap",
    }  # fmt: skip
    assert len(points) > 400


def sample(points: Sequence[Point], count: int) -> list[Point]:
    """``count`` points of each kind of call, the same for the same seed."""
    chosen = random.Random(SEED)
    calls = sorted({point.call for point in points})
    by_call = {call: [point for point in points if point.call == call] for call in calls}
    return [point for call in calls for point in chosen.sample(by_call[call], min(count, len(by_call[call])))]


@pytest.mark.thorough
@pytest.mark.parametrize("error", ["ENOSPC", "EIO"])
def test_a_refused_call_at_a_write_point(
    scripts: ScriptProcesses, points: list[Point], tmp_path: Path, error: str
) -> None:
    for number, point in enumerate(sample(points, 1)):
        inject(scripts, tmp_path / str(number), point, error)


@pytest.mark.thorough
def test_a_disk_that_is_full_for_a_while(scripts: ScriptProcesses, points: list[Point], tmp_path: Path) -> None:
    """Several calls of a kind fail in a row; then the same process goes on."""
    chosen = random.Random(SEED)
    for number, call in enumerate(("pwrite64", "pwrite64", "fsync", "fdatasync", "openat")):
        point = chosen.choice([point for point in points if point.call == call])
        inject(scripts, tmp_path / str(number), point, chosen.choice(["ENOSPC", "EIO"]), chosen.randint(2, 12))


@pytest.mark.thorough
def test_a_directory_that_is_read_only_for_a_while(
    scripts: ScriptProcesses, points: list[Point], tmp_path: Path
) -> None:
    chosen = random.Random(SEED)
    for number, call in enumerate(("openat", "mkdir", "rename")):
        point = chosen.choice([point for point in points if point.call == call])
        inject(scripts, tmp_path / str(number), point, "EROFS", 3)


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("error", ["ENOSPC", "EIO"])
def test_every_write_point(scripts: ScriptProcesses, points: list[Point], tmp_path: Path, error: str) -> None:
    failures = []
    for number, point in enumerate(points):
        try:
            inject(scripts, tmp_path / str(number), point, error)
        except AssertionError as failure:
            failures.append(str(failure))
    assert not failures, f"{len(failures)} of {len(points)}:\n" + "\n".join(failures)


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_every_window_of_refusals(scripts: ScriptProcesses, points: list[Point], tmp_path: Path) -> None:
    failures, chosen = [], random.Random(SEED)
    for number, point in enumerate(points):
        try:
            inject(scripts, tmp_path / str(number), point, chosen.choice(["ENOSPC", "EIO", "EROFS"]), 1 + number % 40)
        except AssertionError as failure:
            failures.append(str(failure))
    assert not failures, f"{len(failures)} of {len(points)}:\n" + "\n".join(failures)
