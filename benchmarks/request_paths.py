"""The files of this project that run during one query and one enrolment over HTTP, in the order of their first call.

    python -m benchmarks.request_paths

Every file counts of which a Python function is called, in whichever thread; calls by compiled code are not seen.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from types import FrameType

import typer

from benchmarks.report import report
from service.commands.timing.samples import jpeg, sample_frame

ROOT = Path(__file__).parents[1]
PLACES = 6
CHILD = "--traced"


class Recorder:
    """Notes files of ``core`` and ``service`` as their functions are called, while it is on; for ``sys.setprofile``."""

    def __init__(self) -> None:
        self.files: dict[str, None] = {}
        self.on = False
        self._folders = tuple(f"{ROOT / name}{os.sep}" for name in ("core", "service"))

    def __call__(self, frame: FrameType, event: str, _argument: object) -> None:
        if self.on and event == "call" and frame.f_code.co_filename.startswith(self._folders):
            self.files.setdefault(os.path.relpath(frame.f_code.co_filename, ROOT))

    def during(self, send: object) -> list[str]:
        """The files that run while ``send`` is called."""
        assert callable(send)
        self.files, self.on = {}, True
        send()
        time.sleep(0.2)  # what is written after the answer
        self.on = False
        return list(self.files)


def trace(port: int, output: Path) -> None:
    """Run the service in this process, send it frames from a thread, and write the files that ran."""
    recorder = Recorder()
    threading.setprofile(recorder)
    sys.setprofile(recorder)
    frames = [jpeg(sample_frame(seed)) for seed in range(PLACES + 1)]

    def send(method: str, path: str, body: bytes | None = None, kind: str = "image/jpeg") -> bytes:
        url, headers = f"http://127.0.0.1:{port}{path}", {"Content-Type": kind}
        request = urllib.request.Request(url, data=body, method=method, headers=headers)
        with urllib.request.urlopen(request, timeout=60) as answer:
            content: bytes = answer.read()
        return content

    def drive() -> None:
        try:
            while True:
                try:
                    send("GET", "/readyz")
                    break
                except OSError:
                    time.sleep(0.1)
            send("POST", "/v1/maps", b'{"id": "lab"}', "application/json")
            for number in range(PLACES):
                send("PUT", f"/v1/maps/lab/places/p{number}?x={10 * number}&y=0", frames[number])
            for number in range(PLACES):  # the first ones compile, open and load
                send("POST", "/v1/maps/lab/query", frames[number])
            time.sleep(1)
            found = {
                "query": recorder.during(lambda: send("POST", "/v1/maps/lab/query", frames[1])),
                "enrolment": recorder.during(lambda: send("PUT", "/v1/maps/lab/places/new?x=90&y=0", frames[PLACES])),
            }
            output.write_text(json.dumps(found))
        finally:
            os._exit(0 if output.exists() else 1)

    threading.Thread(target=drive, daemon=True).start()
    from service.commands import main as placerec

    sys.argv = ["placerec", "serve", "--port", str(port)]
    placerec()


def main() -> None:
    """Trace one query and one enrolment, print the files and write JSON."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "paths.json"
        environment = {**os.environ, "PLACEREC_DATA_DIR": folder, "PLACEREC_HOST": "127.0.0.1"}
        environment["PLACEREC_REQUEST_TIMEOUT"] = "60"
        words = [sys.executable, "-m", "benchmarks.request_paths", CHILD, str(port), str(output)]
        subprocess.run(words, cwd=ROOT, env=environment, check=True, stderr=subprocess.DEVNULL)
        found = json.loads(output.read_text())
    rows = [
        [path, "x" if path in found["query"] else "", "x" if path in found["enrolment"] else ""]
        for path in dict.fromkeys([*found["query"], *found["enrolment"]])
    ]
    rows.append(["all", len(found["query"]), len(found["enrolment"])])
    report("request_paths", "Files that run", ["file", "query", "enrolment"], rows, found)


if __name__ == "__main__":
    if CHILD in sys.argv:
        trace(int(sys.argv[2]), Path(sys.argv[3]))
    else:
        typer.run(main)
