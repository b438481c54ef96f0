"""Compiled loops that came with an installation, as an image: which of them fit this processor, and where Numba finds
them.

Numba keeps what it has compiled for one kind of processor, and reads it only from a folder into which it can write.  An
image is built on one machine, runs on another, and may be read-only.  So its loops are compiled for the builder's
processor and for the levels of x86-64, and a process takes those of the highest level that its own processor has.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import MutableMapping, Set
from contextlib import suppress
from pathlib import Path

SHIPPED = Path(__file__).parents[2] / "numba"
"""Beside the packages; only an image has it."""

PROCESSOR = "processor"
"""The file in it that names the builder's processor."""

LEVELS = {
    "x86-64-v4": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "x86-64-v3": {"avx2", "bmi1", "bmi2", "fma", "f16c", "abm", "movbe"},
    "x86-64-v2": {"sse4_2", "ssse3", "popcnt", "cx16"},
}
"""The instructions of each level that those below it lack, as Linux names them; highest first."""


def levels(instructions: Set[str]) -> list[str]:
    """The levels that a processor with these instructions has, highest first."""
    needed = list(LEVELS.values())
    return [name for index, name in enumerate(LEVELS) if set().union(*needed[index:]) <= instructions]


def instructions() -> set[str]:
    """Which instructions this processor has, as Linux names them; none elsewhere."""
    return set(_said("flags").split())


def processor() -> str:
    """This processor: its name, and every instruction that it has."""
    return f"{_said('model name')}\n{' '.join(sorted(instructions()))}\n"


def _said(name: str) -> str:
    """The value that Linux gives the first processor under a name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def settings_of(level: str) -> dict[str, str]:
    """Numba's variables by which it compiles for a level and finds what was compiled for it."""
    return {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": ""}


def use_shipped(environment: MutableMapping[str, str] = os.environ, shipped: Path = SHIPPED) -> None:
    """Let Numba find the loops that came with this installation; call this before Numba is imported.

    Where there are none, or the user has set a cache or a processor, nothing changes; where they cannot be copied,
    Numba compiles.
    """
    if "NUMBA_CACHE_DIR" in environment or "NUMBA_CPU_NAME" in environment or not shipped.is_dir():
        return
    with suppress(OSError):
        environment["NUMBA_CACHE_DIR"] = str(_own_copy(shipped))
        if (shipped / PROCESSOR).read_text() != processor() and (fitting := levels(instructions())):
            environment.update(settings_of(fitting[0]))


def _own_copy(shipped: Path) -> Path:
    """A copy that belongs to this user alone, for Numba trusts what it finds; the processes of one user share it."""
    place = Path(tempfile.gettempdir()) / f"placerec-numba-{os.getuid()}"
    if _is_ours(place):
        return place
    fresh = Path(tempfile.mkdtemp(prefix=f"{place.name}-", dir=place.parent))
    try:
        shutil.copytree(shipped, fresh, dirs_exist_ok=True)
        fresh.chmod(0o700)
    except OSError:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    with suppress(OSError):
        return fresh.rename(place)
    if not _is_ours(place):  # another user's, whose loops are not to be trusted
        return fresh
    shutil.rmtree(fresh, ignore_errors=True)  # another process was faster
    return place


def _is_ours(place: Path) -> bool:
    try:
        found = place.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
