"""Measures every figure of docs/benchmarks.md and of the README again: its parts, each in a process of its own.

    python -m benchmarks.all                     # every part, some days
    python -m benchmarks.all service enrolment   # two of them
    python -m benchmarks.all --resume            # those that this commit has not measured yet
    python -m benchmarks.all --list              # names, commands, and the time that each took here

Tables are printed.  ``benchmarks/results/all.json`` has of each part the command, the commit, the moment, the seconds,
the figures that it wrote as JSON, and the end of its output; it is written after each part, so that a run can be
resumed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.report import RESULTS
from core.disk.files import write_file

ROOT = Path(__file__).parents[1]
MEASURED = RESULTS / "all.json"
LINES = 40
"""Of the output of a part that are kept."""


@dataclass(frozen=True)
class Part:
    """One program.

    Attributes:
        module: the module that ``python -m`` runs.
        arguments: its arguments; ``{data}`` stands for the folder of the data sets, ``{results}`` for that of the JSON.
        needs: the requirements beyond a checkout with its development environment.
    """

    module: str
    arguments: str = ""
    needs: str = ""

    def command(self, data: Path) -> list[str]:
        """The words of the command, after the interpreter."""
        return ["-m", self.module, *(word.format(data=data, results=RESULTS) for word in self.arguments.split())]


PARTS = {
    "corridor": Part(
        "service.commands",
        "evaluate --dataset corridor --data {data}/eval/corridor --all --training {data}/train/tower"
        " --json {results}/corridor.json",
        "data sets",
    ),
    "maps": Part("benchmarks.maps.map_sizes", "--datasets {data} --repeats 3", "data sets"),
    "stages": Part("lab.training.default_calibration", "--dry-run", "data sets"),
    "vocabularies": Part("lab.training.vocabularies", "--datasets {data}", "data sets"),
    "looks": Part("benchmarks.maps.looks", "--datasets {data}", "data sets"),
    "strangers": Part("benchmarks.learning.strangers", "--datasets {data}", "data sets"),
    "change": Part("benchmarks.learning.change", "--datasets {data}", "data sets"),
    "runs": Part("benchmarks.maps.sequences", "--data {data}/eval", "data sets"),
    "sessions": Part("benchmarks.maps.sessions", "--datasets {data}", "data sets"),
    "day": Part("benchmarks.day", "--datasets {data} --short --json {results}/day.json", "data sets"),
    "speeds": Part("benchmarks.day.speeds", "--datasets {data}", "data sets"),
    "standing": Part("benchmarks.day.standing", "--datasets {data} --poses none", "data sets"),
    "map-to-odom": Part("benchmarks.clients.map_to_odom", "--datasets {data}", "data sets"),
    "learning": Part("benchmarks.learning", "--datasets {data}", "data sets"),
    "learning-http": Part("benchmarks.learning.over_http", "--datasets {data}", "data sets"),
    "own-calibration": Part("benchmarks.learning.own_calibration", "--datasets {data}", "data sets"),
    "self-calibration": Part("benchmarks.learning.calibration", "--datasets {data}", "data sets"),
    "alignment": Part("benchmarks.maps.aligned_maps", "--datasets {data}", "data sets"),
    "pairs": Part("benchmarks.maps.alignment", "--datasets {data}", "data sets"),
    "labels": Part("benchmarks.maps.labels", "{data}/eval --most 130", "data sets"),
    "copies": Part("benchmarks.geometry.same_view", "--datasets {data} --copies 1", "data sets"),
    "poses": Part("benchmarks.geometry.pose", "--data {data}", "data sets"),
    "spacing": Part("benchmarks.geometry.spacing", "--data {data}", "data sets"),
    "encoding": Part("benchmarks.encode"),
    "service": Part("benchmarks.service"),
    "verification": Part("benchmarks.geometry.requests", "--data {data}", "data sets"),
    "enrolment": Part("benchmarks.enrolment"),
    "start": Part("benchmarks.startup"),
    "store": Part("benchmarks.maps.store"),
    "small-maps": Part("benchmarks.maps.small_maps"),
    "access": Part("benchmarks.access"),
    "installation": Part("benchmarks.installation", "HEAD"),
    "search": Part("benchmarks.maps.search", "--datasets {data}", "data sets, 8 GB of disk"),
    "million": Part("benchmarks.maps.search", "--datasets {data} --million", "data sets, 20 GB of disk"),
    "opening": Part("benchmarks.maps.opening", "", "8 GB of disk"),
    "filters": Part("benchmarks.maps.filters"),
    "transfer": Part("benchmarks.transfer"),
    "client": Part("benchmarks.clients.python"),
    "ros2": Part("benchmarks.clients.ros2", "", ".venv-ros"),
    "ros2-corridor": Part("benchmarks.clients.ros2", "--corridor", ".venv-ros, data sets"),
    "console": Part("benchmarks.console.pages", "", "Chromium, 8 GB of disk"),
    "siege": Part("benchmarks.slow_connections"),
    "fairness": Part("benchmarks.fairness"),
    "load": Part("benchmarks.endurance"),
    "crashes": Part("tests.durability", "storage --kills 200"),
    "server-crashes": Part("tests.durability", "server --kills 100"),
    "power": Part("tests.durability", "power --runs 4 --disks 60"),
    "hostile": Part("tests.fuzz", "images --count 50000"),
    "parsers": Part("tests.fuzz", "files --minutes 15"),
    "requests": Part("tests.fuzz", "api --minutes 3"),
    "mangled": Part("tests.fuzz", "http --count 3000"),
    "streams": Part("tests.fuzz", "streams --count 3000"),
    "write-points": Part("pytest", "tests/faults/test_write_points.py -m soak"),
    "damaged-files": Part("pytest", "tests/faults/test_damaged_files.py -m soak"),
    "client-faults": Part("pytest", "tests/clients/python/test_faults.py -m soak"),
    "takeover": Part("pytest", "tests/service/jobs/test_services.py -m thorough", "PostgreSQL"),
    "milvus": Part("benchmarks.cluster.search", "--datasets {data} --places 100000", "data sets, .venv-cluster"),
    "engines": Part("benchmarks.cluster.engines", "--service", "PostgreSQL"),
    "sizing": Part("benchmarks.cluster.sizing", needs="PostgreSQL"),
    "kills": Part("tests.core.cluster.kills", "--kills 100", "PostgreSQL"),
}
"""The parts by name, accuracy first, then speed, then robustness and clusters."""


def main(
    names: Annotated[list[str] | None, typer.Argument(metavar="[PART]…", help="Default: all, in this order.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="Show the parts and run none.")] = False,
    resume: Annotated[bool, typer.Option(help="Leave out parts that this commit has measured.")] = False,
    data: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
) -> None:
    """Run the parts, go on after one that fails, and end with status 1 if any did."""
    if unknown := [name for name in names or () if name not in PARTS]:
        raise typer.BadParameter(f"There is no part {', '.join(unknown)}. Parts are {', '.join(PARTS)}.")
    chosen = names or list(PARTS)
    if listed:
        show(chosen, data)
        return
    RESULTS.mkdir(exist_ok=True)
    commit = state()
    if resume:
        before = measured()
        chosen = [name for name in chosen if before.get(name, {}).get("commit") != commit]
    failed = [name for name in chosen if not measure(name, data, commit)]
    if failed:
        print(f"Failed: {', '.join(failed)}.", file=sys.stderr)
        raise typer.Exit(1)


def state() -> str:
    """The commit of the checkout; with a plus if files differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


def measure(name: str, data: Path, commit: str) -> bool:
    """Run one part and note what it has measured; whether it succeeded."""
    words = PARTS[name].command(data)
    print(f"\n{name}: python {' '.join(words)}", flush=True)
    moment, begun, wall = datetime.now(UTC), time.monotonic(), time.time()
    last: deque[str] = deque(maxlen=LINES)
    with subprocess.Popen(
        [sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, errors="replace"
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            last.append(line.rstrip())
    if process.returncode == 0:
        written = [path for path in sorted(RESULTS.glob("*.json")) if path != MEASURED and path.stat().st_mtime >= wall]
        found = {
            "command": f"python {' '.join(words)}",
            "commit": commit,
            "at": moment.isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - begun),
            "figures": {path.stem: json.loads(path.read_text()) for path in written},
            "output": list(last),
        }
        write_file(MEASURED, (json.dumps({**measured(), name: found}, indent=1) + "\n").encode(), private=False)
    return process.returncode == 0


def measured() -> dict[str, Any]:
    """The figures by the names of the parts that last succeeded here."""
    found: dict[str, Any] = json.loads(MEASURED.read_text()) if MEASURED.exists() else {}
    return found


def show(names: list[str], data: Path) -> None:
    """Print names, commands, requirements, and the times of the last runs."""
    took = measured()
    for name in names:
        part = PARTS[name]
        spent = f"{took[name]['seconds']} s the last time" if name in took else "not timed here"
        print(f"{name}: python {' '.join(part.command(data))}")
        print(f"    {spent}{f'; needs {part.needs}' if part.needs else ''}")


if __name__ == "__main__":
    typer.run(main)
