"""Enrolment of a folder of frames over HTTP, against encoding them in batches in this process: at least 70 %.

    python -m benchmarks.enrolment

The command ``placerec enrol DIR --url`` is run as a user runs it, in a process of its own, and its whole time counts
but for that of its start, which is measured with a folder of one frame.  Each round takes a new map.  With ``--direct``
the command opens a data directory itself instead.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.frames import camera_frames
from benchmarks.process import ROOT, median, peak_memory, service
from benchmarks.report import report, verdict
from benchmarks.service import BATCH, SETTLE, encode_in_batches
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.threads import allowed_threads, share_cores
from service.malloc import configure_malloc

LIMIT = 0.7


def enrol(folder: Path, map_id: str, where: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """Seconds that the command took, and the most memory that its process has had, in MB (10^6 bytes)."""
    words = [sys.executable, "-m", "service.commands", "enrol", str(folder), "--map", map_id, "--create", *where]
    began = time.perf_counter()
    process = subprocess.Popen(words, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    peak = 0.0
    while process.poll() is None:
        peak = max(peak, peak_memory(process.pid))
        time.sleep(0.02)
    spent = time.perf_counter() - began
    if process.returncode:
        assert process.stderr is not None
        raise RuntimeError(f"placerec enrol ended with {process.returncode}: {process.stderr.read().decode()[-2000:]}")
    return spent, peak


def main(
    encoder: str = DEFAULT_ENCODER,
    frames: Annotated[int, typer.Option(min=16, help="In the folder.")] = 600,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    seconds: Annotated[float, typer.Option(min=0.5, help="Of encoding in this process, each round.")] = 4.0,
    direct: Annotated[bool, typer.Option("--direct", help="Without a service.")] = False,
) -> None:
    """Medians over the rounds, which take turns."""
    chosen = EncoderCatalogue().get(encoder)
    data, content = camera_frames(frames, "reference")
    rates: list[float] = []
    batched: list[float] = []
    again: list[float] = []
    starts: list[float] = []
    memory: dict[str, float] = {}
    configure_malloc()  # as the service does
    share_cores(allowed_threads())
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        for name, part in (("all", data), ("one", data[:1])):
            (folder / name).mkdir()
            for index, one in enumerate(part):
                (folder / name / f"{index:05d}.jpg").write_bytes(one)
        with service(folder / "data") as process:
            where = ["--data-dir", str(folder / "direct")] if direct else ["--url", str(process.client.base_url)]
            environment = {**os.environ}
            for turn in range(rounds + 1):
                time.sleep(SETTLE)
                rate = encode_in_batches(chosen, data, 1.0 if turn == 0 else seconds)
                time.sleep(SETTLE)
                start, _ = enrol(folder / "one", f"one-{turn}", where, environment)
                spent, peak = enrol(folder / "all", f"all-{turn}", where, environment)
                known, _ = enrol(folder / "all", f"all-{turn}", where, environment)
                if turn:
                    batched.append(rate)
                    starts.append(start)
                    rates.append((frames - 1) / (spent - start))
                    again.append(known)
                    memory["command"] = max(memory.get("command", 0.0), peak)
            memory["service"] = process.peak_memory()
    here, there = median(batched), median(rates)
    ratio = there / here
    rows: list[tuple[object, ...]] = [
        (f"here: encode in batches of {BATCH}", here, ""),
        ("enrolled a second", there, f"{100 * ratio:.0f} %: {verdict(ratio, LIMIT, at_least=True)}"),
        ("the same again, s", median(again), "none is sent"),
        ("start of the command, s", median(starts), "not counted"),
        ("peak memory of the command, MB", memory["command"], ""),
        ("peak memory of the service, MB", memory["service"], "" if not direct else "idle"),
    ]
    figures: dict[str, Any] = {
        "encoder": chosen.identity,
        "content": content,
        "frames": frames,
        "direct": direct,
        "batched_frames_per_second": here,
        "enrolled_per_second": there,
        "again_seconds": median(again),
        "ratio": ratio,
        "peak_megabytes": memory,
    }
    how = "by the command alone" if direct else "over HTTP"
    name = "enrolment-direct" if direct else "enrolment"
    report(name, f"{chosen.name}, {frames} frames {how}, {content}", ["", "", ""], rows, figures)


if __name__ == "__main__":
    typer.run(main)
