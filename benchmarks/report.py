"""The output of every benchmark: a table, and JSON in ``benchmarks/results`` (not in the repository)."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from core.threads import allowed_threads

RESULTS = Path(__file__).parent / "results"


def processor() -> str:
    """The processor's name, as far as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def report(
    name: str, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], figures: dict[str, Any]
) -> None:
    """Print a table and write ``results/<name>.json``."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left")
    for row in rows:
        table.add_row(*(f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in row))
    Console().print(table)
    machine = {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "threads": allowed_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    moment = datetime.now(UTC).isoformat(timespec="seconds")
    path.write_text(json.dumps({"name": name, "at": moment, "machine": machine, **figures}, indent=2) + "\n")
    print(f"load average {machine['load']:.1f} on {machine['cores']} cores; written to {path}")


def verdict(value: float, limit: float, at_least: bool = False) -> str:
    """A limit and whether it is met."""
    met = value >= limit if at_least else value <= limit
    return f"{'≥' if at_least else '≤'} {limit:g}: {'met' if met else 'MISSED'}"
