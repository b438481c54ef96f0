"""Measures the figures of docs/benchmarks.md again: its parts, one after the other, each in a process of its own.

    python -m benchmarks.all                     # every part, some hours
    python -m benchmarks.all service enrolment   # two of them
    python -m benchmarks.all --list              # names, commands, and the time that each took here

Tables are printed; figures are written as JSON to ``benchmarks/results``, and the time of each part to
``benchmarks/results/times.json``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.report import RESULTS

ROOT = Path(__file__).parents[1]
TIMES = RESULTS / "times.json"


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
    "looks": Part("benchmarks.maps.looks", "--datasets {data}", "data sets"),
    "runs": Part("benchmarks.maps.sequences", "--data {data}/eval", "data sets"),
    "sessions": Part("benchmarks.maps.sessions", "--datasets {data}", "data sets"),
    "day": Part("benchmarks.day", "--datasets {data} --short --json {results}/day.json", "data sets"),
    "map-to-odom": Part("benchmarks.clients.map_to_odom", "--datasets {data}", "data sets"),
    "learning": Part("benchmarks.learning", "--datasets {data}", "data sets"),
    "alignment": Part("benchmarks.maps.aligned_maps", "--datasets {data}", "data sets"),
    "poses": Part("benchmarks.geometry.pose", "--data {data}", "data sets"),
    "spacing": Part("benchmarks.geometry.spacing", "--data {data}", "data sets"),
    "encoding": Part("benchmarks.encode"),
    "service": Part("benchmarks.service"),
    "verification": Part("benchmarks.geometry.requests", "--data {data}", "data sets"),
    "enrolment": Part("benchmarks.enrolment"),
    "start": Part("benchmarks.startup"),
    "search": Part("benchmarks.maps.search", "--datasets {data}", "data sets, 8 GB of disk"),
    "million": Part("benchmarks.maps.search", "--datasets {data} --million", "data sets, 20 GB of disk"),
    "filters": Part("benchmarks.maps.filters"),
    "transfer": Part("benchmarks.transfer"),
    "siege": Part("benchmarks.slow_connections"),
    "fairness": Part("benchmarks.fairness"),
    "load": Part("benchmarks.endurance"),
    "crashes": Part("tests.durability", "storage --kills 200"),
    "power": Part("tests.durability", "power --runs 4 --disks 60"),
    "hostile": Part("tests.fuzz", "images --count 50000"),
    "cluster": Part("benchmarks.cluster.answers", "--datasets {data}", "data sets, PostgreSQL, scripts/cluster"),
    "ray": Part("benchmarks.ray_serve.overhead", "--places 400 --robots 1 --robots 16", "placerec[ray]"),
}
"""The parts by name, accuracy first, then speed, then robustness and clusters."""


def main(
    names: Annotated[list[str] | None, typer.Argument(metavar="[PART]…", help="Default: all, in this order.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="Show the parts and run none.")] = False,
    data: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
) -> None:
    """Run the parts, go on after one that fails, and end with status 1 if any did."""
    if unknown := [name for name in names or () if name not in PARTS]:
        raise typer.BadParameter(f"There is no part {', '.join(unknown)}. Parts are {', '.join(PARTS)}.")
    if listed:
        show(names or list(PARTS), data)
        return
    RESULTS.mkdir(exist_ok=True)
    failed = [name for name in names or PARTS if not measured(name, data)]
    if failed:
        print(f"Failed: {', '.join(failed)}.", file=sys.stderr)
        raise typer.Exit(1)


def measured(name: str, data: Path) -> bool:
    """Run one part and note how long it took; whether it succeeded."""
    words = PARTS[name].command(data)
    print(f"\n{name}: python {' '.join(words)}", flush=True)
    begun = time.monotonic()
    code = subprocess.run([sys.executable, *words], cwd=ROOT, check=False).returncode
    if code == 0:
        TIMES.write_text(json.dumps({**times(), name: round(time.monotonic() - begun)}, indent=2) + "\n")
    return code == 0


def times() -> dict[str, int]:
    """Seconds that parts took when they last succeeded here."""
    return json.loads(TIMES.read_text()) if TIMES.exists() else {}


def show(names: list[str], data: Path) -> None:
    """Print names, commands, requirements, and the times of the last runs."""
    took = times()
    for name in names:
        part = PARTS[name]
        spent = f"{took[name]} s the last time" if name in took else "not timed here"
        print(f"{name}: python {' '.join(part.command(data))}")
        print(f"    {spent}{f'; needs {part.needs}' if part.needs else ''}")


if __name__ == "__main__":
    typer.run(main)
