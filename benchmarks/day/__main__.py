"""Runs the table: ``python -m benchmarks.day``."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.day.drive import drive
from benchmarks.day.maps import make_map
from benchmarks.day.robots import MODES
from benchmarks.day.situations import SITUATIONS, moments
from benchmarks.day.table import Row, show
from benchmarks.day.walks import WALKS
from benchmarks.process import service
from lab.training.photographs import find_photographs
from placerec_client import Client

SHORT = 0.5
USUAL = "*:auto:small"


class Station:
    """A service on a folder, which can be restarted where it is."""

    def __init__(self, folder: Path) -> None:
        """Not started."""
        self._folder, self._stack, self._port = folder, ExitStack(), 0
        self.url = ""

    def start(self) -> None:
        """Start it, and return when it is ready."""
        log = self._folder / "log"
        process = self._stack.enter_context(service(self._folder / "data", log=log, port=self._port))
        self.url = str(process.client.base_url).rstrip("/")
        self._port = process.client.base_url.port or 0

    def stop(self) -> None:
        """End it as an operator would."""
        self._stack.close()

    def restart(self) -> None:
        """End it and start it again."""
        self.stop()
        self.start()


def chosen(names: Sequence[str], patterns: str) -> list[str]:
    """The names that a list of patterns with commas names, in their order.

    Raises:
        typer.BadParameter: a pattern names none.
    """
    wanted = [one.strip() for one in patterns.split(",")]
    for pattern in wanted:
        if not any(fnmatch(name, pattern) for name in names):
            raise typer.BadParameter(f"{pattern} is none of: {', '.join(names)}.")
    return [name for name in names if any(fnmatch(name, pattern) for pattern in wanted)]


def main(
    situations: Annotated[str, typer.Option(help="Names or patterns, with commas between.")] = "*",
    modes: Annotated[str, typer.Option(help="asking:verify:size, or patterns, with commas between.")] = USUAL,
    walk: Annotated[str, typer.Option(help=f"One of {', '.join(WALKS)}.")] = "corridor",
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    short: Annotated[bool, typer.Option("--short", help="Half the seconds.")] = False,
    to: Annotated[Path | None, typer.Option("--json", help="A file for the figures.")] = None,
) -> None:
    """Drive, print the table, and keep the figures."""
    selected = [SITUATIONS[name] for name in chosen(list(SITUATIONS), situations)]
    ways = {str(mode): mode for mode in MODES}
    wanted = [ways[name] for name in chosen(list(ways), modes)]
    driven = WALKS[chosen(list(WALKS), walk)[0]](datasets)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        station = Station(Path(folder))
        station.start()
        try:
            made: set[str] = set()
            for situation in selected:
                way = list(moments(situation, driven, SHORT if short else 1.0))
                for mode in wanted:
                    map_id = f"{situation.map}-{mode.size}"
                    if map_id not in made:
                        made.add(map_id)
                        others = _others(datasets) if mode.size == "large" else []
                        with Client(station.url) as client:
                            make_map(client, map_id, driven, situation.map, mode.size, others)
                    row = Row(situation.name, mode, drive(station.url, map_id, mode, way, station.restart))
                    rows.append(row)
                    print(f"{situation.name:32} {mode!s:24} {row.drive.trail}", flush=True)
        finally:
            station.stop()
    show(driven.name, rows, to)


def _others(datasets: Path) -> list[bytes]:
    """Pictures of environments that no walk shows and no stranger is from, for a large map."""
    return [path.read_bytes() for path in find_photographs(datasets / "train/camvid")]


if __name__ == "__main__":
    typer.run(main)
