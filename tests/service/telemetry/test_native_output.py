"""What libraries write to standard error is a line of the log."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.service.scenes import encoded, scene
from tests.service.server import ROOT, Server
from tests.service.wire import eventually

PROGRAM = """
import os, sys
from service.telemetry.native_output import logged_stderr
from service.telemetry.requests import configure_logging
with logged_stderr():
    configure_logging("debug")
    os.write(2, b"Corrupt JPEG data: premature end\\n")
    os.write(2, b"half of a line, ")
    os.write(2, b"\\x00\\xff and the other\\n" + b"x" * 30_000 + b"\\nafter it\\nwithout an end")
    print("from Python", file=sys.stderr)
os.write(2, b"as before\\n")
"""


@pytest.mark.thorough
def test_lines_are_logged_cut_and_distinguished() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, timeout=300, check=True)
    *said, last = done.stderr.decode().splitlines()
    said.remove("from Python")
    lines = [json.loads(line) for line in said]
    assert {line["logger"] for line in lines} == {"placerec.native"} and last == "as before"
    told = [(line["level"], line["message"]) for line in lines]
    assert told[0] == ("debug", "Corrupt JPEG data: premature end")
    assert told[1] == ("warning", "half of a line, \x00\\xff and the other")
    assert told[2] == ("warning", "x" * 500)
    assert told[3:] == [("warning", "after it"), ("warning", "without an end")]


def test_an_odd_picture_leaves_no_line_that_is_not_json(strict: Server) -> None:
    whole = encoded(scene(4))
    padded = whole[:-2] + bytes(3) + whole[-2:]  # a decoder remarks on this
    assert strict.client.post("/v1/encode", content=padded, headers={"Content-Type": "image/jpeg"}).status_code == 200
    assert eventually(lambda: bool(strict.lines(logger="placerec.native", level="debug")))
    for line in strict.log_file.read_text().splitlines():
        assert {"time", "level", "logger", "message"} <= set(json.loads(line))
