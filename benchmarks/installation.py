"""The installation by ``scripts/serve``: its packages, time, and memory once it runs; of commits beside each other.

    python -m benchmarks.installation [COMMIT …] [--keep FOLDER]

Each commit (default: HEAD) is checked out into a temporary folder, and its own ``scripts/environment service`` makes a
.venv there.  uv and pip use their caches as they are, so a run says more after another.  ``--keep`` keeps the folders.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.report import report

ROOT = Path(__file__).parents[1]
IMPORT = """
try:
    import service.app.application
except ImportError:  # until 0.1.0 it was a module
    import service.app
print(open("/proc/self/status").read().partition("VmHWM:")[2].split()[0])
"""
REPEATS = 5


def checked_out(commit: str, folder: Path) -> Path:
    """The files of a commit in a folder of their own."""
    target = folder / commit.replace("/", "-")
    target.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True).stdout
    subprocess.run(["tar", "-x"], cwd=target, input=archive, check=True)
    return target


def megabytes(folder: Path) -> float:
    """The size of a folder on disk; files that it shares with a cache count."""
    text = subprocess.run(["du", "-sm", folder], check=True, capture_output=True, text=True).stdout
    return float(text.split()[0])


def processor_seconds() -> float:
    """Seconds of processor that the processes started so far have used; a busy machine changes them little."""
    times = os.times()
    return times.children_user + times.children_system


def installed(checkout: Path) -> dict[str, Any]:
    """Install a checkout's service, and import it in fresh processes: seconds, packages, megabytes."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    began, before = time.monotonic(), processor_seconds()
    setup = f"set -eu; . '{checkout}/scripts/environment'; environment service"
    subprocess.run(["bash", "-c", setup], cwd="/", env=environment, check=True)
    seconds, busy = time.monotonic() - began, processor_seconds() - before
    venv = checkout / ".venv"
    (packages,) = venv.glob("lib/python3*/site-packages")
    imports, memory = [], 0.0
    for _ in range(REPEATS):
        before = processor_seconds()
        command = [str(venv / "bin/python"), "-c", IMPORT]
        found = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, check=True)
        imports.append(processor_seconds() - before)
        memory = int(found.stdout) / 1024
    return {
        "installation, s": seconds,
        "installation, s of processor": busy,
        "packages": len(list(packages.glob("*.dist-info"))),
        "MB of .venv": megabytes(venv),
        "import of the service, s of processor, best of 5": min(imports),
        "MB of memory after the import": memory,
    }


def main(
    commits: Annotated[list[str] | None, typer.Argument(metavar="[COMMIT]…")] = None, keep: Path | None = None
) -> None:
    """Install each commit and print a table."""
    chosen = commits or ["HEAD"]
    with tempfile.TemporaryDirectory() as temporary:
        figures = {commit: installed(checked_out(commit, keep or Path(temporary))) for commit in chosen}
    names = list(figures[chosen[0]])
    rows = [(name, *(figures[commit][name] for commit in chosen)) for name in names]
    report("installation", "what scripts/serve installs", ("what", *chosen), rows, figures)


if __name__ == "__main__":
    typer.run(main)
