"""The service with its forward passes on the processor, and on a GPU where there is one: answers, and robots.

    python -m benchmarks.devices.served

Corridor's references are enrolled over HTTP in a service of each device, and its queries asked there.  Verdicts that
differ, and the largest difference of probabilities, are those between the two services.  Then 1, 16 and 64 robots send
frames of 640 × 480; nothing is verified for them, so that the forward pass is most of their work.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

import httpx
import numpy as np
import torch
import typer

from benchmarks.frames import camera_frames
from benchmarks.process import service
from benchmarks.report import processor, report
from core.networks.backbone import Device
from core.threads import cores
from lab.training.validation import load_traverses
from service.commands.load import measure

MAP = "corridor"
JPEG = {"Content-Type": "image/jpeg"}
THREADS_OF_A_CORE: dict[Device, int] = {"cpu": 1, "cuda": 2}
"""A thread sleeps while its frame is computed on a GPU."""


def enrol(client: httpx.Client, folder: Path) -> None:
    """A map of the references, whose ids are their numbers."""
    client.post("/v1/maps", json={"id": MAP}).raise_for_status()
    for number, path in enumerate(sorted(folder.iterdir())):
        about = {"sequence": "reference"}
        answer = client.put(f"/v1/maps/{MAP}/places/{number}", params=about, content=path.read_bytes(), headers=JPEG)
        answer.raise_for_status()


def ask(client: httpx.Client, folder: Path) -> list[dict[str, Any]]:
    """The answers to the queries, in order."""
    found = []
    for path in sorted(folder.iterdir()):
        answer = client.post(f"/v1/maps/{MAP}/query", content=path.read_bytes(), headers=JPEG).raise_for_status()
        found.append(answer.json())
    return found


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with eval/corridor.")] = Path("../shared/datasets"),
    robots: Annotated[list[int] | None, typer.Option(help="Several times; default 1, 16, 64.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Of each number of robots.")] = 6.0,
) -> None:
    """Ask both and compare."""
    devices: list[Device] = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    numbers = robots or [1, 16, 64]
    frames, content = camera_frames(64)
    corridor = datasets / "eval/corridor"
    truth = load_traverses(corridor, "query", "ref").truth
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    answers: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        (folder / "frames").mkdir()
        for index, data in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(data)
        for device in devices:
            settings = {"DEVICE": device, "QUEUE_LENGTH": 2 * max(numbers)}
            threads = THREADS_OF_A_CORE[device] * cores()
            with service(folder / device, threads, settings, folder / "log") as process:
                enrol(process.client, corridor / "ref")
                answers[device] = ask(process.client, corridor / "query")
                url, path = str(process.client.base_url), f"/v1/maps/{MAP}/query?verify=never"
                measure(url, path, folder / "frames", max(numbers), 2.0)  # warms up
                seen = {number: measure(url, path, folder / "frames", number, seconds) for number in numbers}
                best = [answer["matches"][0]["place"]["id"] for answer in answers[device]]
                right = [bool(truth[query, int(place)]) for query, place in enumerate(best)]
                loads = {
                    str(number): {
                        "per_second": len(one["milliseconds"]) / one["seconds"],
                        "p50": float(np.median(one["milliseconds"])),
                        "p99": float(np.percentile(one["milliseconds"], 99)),
                        "statuses": one["statuses"],
                    }
                    for number, one in seen.items()
                }
                figures[device] = {
                    "ready": process.ready,
                    "megabytes": process.memory(),
                    "recall": float(np.mean(right)),
                    "robots": loads,
                }
            shown = [f"{load['per_second']:.0f}/s, {load['p50']:.1f} ms" for load in loads.values()]
            rows.append((device, process.ready, float(np.mean(right)), *shown))
    if len(devices) == 2:
        pairs = list(zip(answers["cpu"], answers["cuda"], strict=True))
        figures["verdicts_differ"] = sum(one["verdict"] != other["verdict"] for one, other in pairs)
        figures["best_differ"] = sum(
            one["matches"][0]["place"]["id"] != other["matches"][0]["place"]["id"] for one, other in pairs
        )
        figures["probability_apart"] = max(abs(one["probability"] - other["probability"]) for one, other in pairs)
    names = [processor(), *(torch.cuda.get_device_name() for device in devices if device == "cuda")]
    columns = ["device", "ready, s", "recall@1", *(f"{number} robots" for number in numbers)]
    report("devices_served", f"{', '.join(names)}; {content}", columns, rows, {"devices": figures})
    for what in ("verdicts_differ", "best_differ", "probability_apart"):
        if what in figures:
            print(f"{what.replace('_', ' ')}: {figures[what]:.4g}")


if __name__ == "__main__":
    typer.run(main)
