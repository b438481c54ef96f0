"""The compiled loops of an image: they fit the processor, and are the user's own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from core.kernels.compiled import LEVELS, PROCESSOR, instructions, levels, processor, settings_of, use_shipped

ALL = set().union(*LEVELS.values())


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    return place


@pytest.fixture
def shipped(tmp_path: Path) -> Path:
    folder = tmp_path / "numba"
    folder.mkdir()
    (folder / "loops").write_text("compiled")
    (folder / PROCESSOR).write_text(processor())
    return folder


def test_a_processor_has_a_level_with_all_instructions_of_it_and_of_those_below() -> None:
    assert levels(ALL) == list(LEVELS)
    assert levels(ALL - {"avx512vl"}) == ["x86-64-v3", "x86-64-v2"]
    assert levels(ALL - {"fma"}) == ["x86-64-v2"]
    assert levels({"neon"}) == []


def test_each_user_has_one_copy_and_the_builders_processor_needs_no_level(shipped: Path, temporary: Path) -> None:
    found: dict[str, str] = {}
    use_shipped(found, shipped)
    copy = temporary / f"placerec-numba-{os.getuid()}"
    assert found == {"NUMBA_CACHE_DIR": str(copy)}
    assert (copy / "loops").read_text() == "compiled" and copy.stat().st_mode & 0o077 == 0
    (copy / "more").touch()
    use_shipped(again := {}, shipped)  # type: ignore[var-annotated]
    assert again == found and (copy / "more").exists()
    assert [path.name for path in temporary.iterdir()] == [copy.name]


def test_what_others_can_write_is_not_used(shipped: Path, temporary: Path) -> None:
    planted = temporary / f"placerec-numba-{os.getuid()}"
    planted.mkdir()
    (planted / "loops").write_text("planted")
    planted.chmod(0o777)
    use_shipped(found := {}, shipped)  # type: ignore[var-annotated]
    assert (Path(found["NUMBA_CACHE_DIR"]) / "loops").read_text() == "compiled"
    assert (planted / "loops").read_text() == "planted"


def test_another_processor_takes_its_highest_level(shipped: Path) -> None:
    (shipped / PROCESSOR).write_text("another\n")
    use_shipped(found := {}, shipped)  # type: ignore[var-annotated]
    highest = levels(instructions())[:1]
    assert {name: found[name] for name in found if name != "NUMBA_CACHE_DIR"} == (
        settings_of(highest[0]) if highest else {}
    )


@pytest.mark.parametrize("name", ["NUMBA_CACHE_DIR", "NUMBA_CPU_NAME"])
def test_what_the_user_has_set_stays(shipped: Path, name: str) -> None:
    use_shipped(found := {name: "mine"}, shipped)
    assert found == {name: "mine"}


def test_a_checkout_and_a_full_disk_do_without(shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_shipped(found := {}, tmp_path / "missing")  # type: ignore[var-annotated]
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "no such folder"))
    use_shipped(found, shipped)
    assert found == {}


CALL = """
import os, sys
from pathlib import Path
from core.kernels.compiled import use_shipped
use_shipped(os.environ, Path(sys.argv[1]))
import numpy as np
from core.kernels.sampling import interpolated
print(interpolated(np.ones((4, 4, 2), np.float32), np.ones(1, np.float32), np.ones(1, np.float32)).tolist())
"""


@pytest.mark.thorough
def test_loops_that_were_compiled_for_a_level_are_loaded_and_not_compiled(tmp_path: Path) -> None:
    highest = levels(instructions())[:1]
    if not highest:
        pytest.skip("the processor has none of the levels")
    folder = tmp_path / "numba"
    folder.mkdir()
    (folder / PROCESSOR).write_text("another\n")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}

    def run(**more: str) -> str:
        settings = environment | {"NUMBA_DEBUG_CACHE": "1", "TMPDIR": str(tmp_path)} | more
        command = [sys.executable, "-c", CALL, str(folder)]
        done = subprocess.run(command, env=settings, capture_output=True, text=True, check=True, timeout=300)
        assert "[[1.0, 1.0]]" in done.stdout
        return done.stdout

    assert "data saved to" in run(NUMBA_CACHE_DIR=str(folder), **settings_of(highest[0]))
    found = run()
    assert "data loaded from" in found and "data saved to" not in found
    assert str(tmp_path / f"placerec-numba-{os.getuid()}") in found
