"""Dependencies that report are switched off before they load; tests/test_silence.py watches that they are silent."""

from __future__ import annotations

import subprocess
import sys

import pytest

from core.silence import SWITCHES, keep_silent


@pytest.mark.parametrize("before", [{}, {"ORT_DISABLE_TELEMETRY": "0", "FASTAPI_OTEL_AUTO_CONFIGURE": "true"}])
def test_nobody_can_switch_reports_on(before: dict[str, str]) -> None:
    keep_silent(before)
    assert before == SWITCHES


@pytest.mark.thorough
@pytest.mark.parametrize("module", ["core.networks.forward", "service.app.application"])
def test_what_reports_is_imported_after_it_is_switched_off(module: str) -> None:
    code = f"import os, sys, importlib.abc\n{WATCH}\nimport {module}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


WATCH = f"""
os.environ.update(dict.fromkeys({list(SWITCHES)}, "neither"))
class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name in ("onnxruntime", "fastapi"):
            assert os.environ.items() >= {SWITCHES}.items(), name + " is imported too early"
sys.meta_path.insert(0, Watch())
"""
