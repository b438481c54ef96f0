"""schemathesis over everything that the OpenAPI document of a running service describes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.service.server import ROOT

CONFIGURATION = Path(__file__).with_name("schemathesis.toml")

TIGHT: dict[str, object] = {
    "max_image_bytes": 60_000,
    "max_image_pixels": 400_000,
    "max_batch_items": 4,
    "max_batch_bytes": 150_000,
    "max_upload_memory": 2_000_000,
    "max_json_bytes": 8192,
    "max_metadata_bytes": 400,
}
"""Limits that generated requests reach."""

ALL = "examples,coverage,fuzzing,stateful"
"""The phases: the examples of the document, its boundaries, drawn requests, chains of requests along links."""


def run(
    url: str, seed: int, phases: str = ALL, more: Sequence[str] = (), key: str | None = None
) -> subprocess.CompletedProcess[str]:
    """All checks on all operations; the status is 0 if every check held.

    Args:
        url: of the service.
        seed: of what is drawn.
        more: arguments of ``schemathesis run``.
        key: of the service; None if it has no keys, which it gets as soon as a drawn request creates one.
    """
    command = [sys.executable, "-c", "from schemathesis.cli import schemathesis; schemathesis()"]
    command += ["--config-file", str(CONFIGURATION), "run", f"{url}/openapi.json", "--no-color"]
    command += ["--checks", "all", "--phases", phases, "--seed", str(seed), "--continue-on-failure", *more]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if key is not None:
        command += ["--header", f"Authorization: Bearer {key}"]
        environment["PLACEREC_KEY"] = key  # for tests.fuzz.hooks
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
