"""The commands of the documents in docs/, as they are written, against a real service."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.server import ROOT, Server

DOCUMENTS = sorted((ROOT / "docs").rglob("*.md"))
BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)

# A refusal by the service is an error of the document; curl alone would not see it as one.
PRELUDE = 'curl() { command curl --fail-with-body --show-error "$@"; }\n'

WITH_COMMANDS = [document for document in DOCUMENTS if BLOCK.search(document.read_text())]


@pytest.mark.parametrize("document", WITH_COMMANDS, ids=lambda document: document.stem)
def test_the_commands_run_as_they_are_written(document: Path, tmp_path: Path) -> None:
    here = tmp_path / "here"
    drawn = subprocess.run(
        [sys.executable, "examples/make_pictures.py", here / "pictures"], cwd=ROOT, capture_output=True, timeout=100
    )
    assert drawn.returncode == 0, drawn.stderr
    shutil.copytree(ROOT / "examples", here / "examples")
    service = Server(tmp_path / "service").wait()
    try:
        root = str(service.client.base_url).rstrip("/")
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        environment = {**os.environ, "url": root, "api": f"{root}/v1", "PATH": path}
        environment["PLACEREC_DATA_DIR"] = str(service.data_dir)  # for what is done beside a running service
        script = PRELUDE + "\n".join(BLOCK.findall(document.read_text()))
        done = subprocess.run(
            ["bash", "-euxo", "pipefail", "-c", script],
            cwd=here,
            env=environment,
            capture_output=True,
            text=True,
            timeout=110,
        )
        assert done.returncode == 0, f"{done.stderr[-3000:]}\n{done.stdout[-3000:]}"
    finally:
        status = service.stop()
    assert status == 0
