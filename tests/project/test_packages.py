"""``scripts/packages.py``: uv looks where pip is configured to look; what happens where it, or an index, is missing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scripts.packages import uv_settings

ROOT = Path(__file__).parents[2]

# Replaces Python, and the uv that it installs: each installation is a line in a log; the rest is real.
STUB = """#!/bin/bash
case "$*" in
    *config*) echo "global.find-links='/wheels /more'" ;;
    *--target*)
        [ ! -e "$LOG.no-uv" ] || exit 1
        while [ "$1" != --target ]; do shift; done
        mkdir "$2/bin" && cp "$0" "$2/bin/uv" && echo "pip installer.lock" >>"$LOG" ;;
    *)
        tool=uv; [ "$1" != -m ] || tool=pip
        case "$*" in *--torch-backend*) [ ! -e "$LOG.no-index" ] || exit 1; more=" $TORCH_BACKEND" ;; esac
        [ "$tool" = pip ] || [ "$UV_FIND_LINKS" = /wheels,/more ] || exit 1
        [ ! -e "$LOG.full" ] || exit 1
        echo "$tool ${@: -1:1}${more:-}" | sed "s|/.*/||" >>"$LOG" ;;
esac
"""


def installed(folder: Path, *missing: str) -> tuple[list[str], str, int]:
    """What ``packages.py service`` installs, what it says, and its status; ``missing`` is what it does not find."""
    stub, log = folder / "python", folder / "log"
    stub.write_text(STUB)
    stub.chmod(0o755)
    log.touch()
    for what in missing:
        Path(f"{log}.{what}").touch()
    code = f"import sys; sys.executable = {str(stub)!r}; from scripts.packages import main; sys.exit(main('service'))"
    environment = {**os.environ, "LOG": str(log), "TORCH_BACKEND": "cpu", "PYTHONPATH": str(ROOT)}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    return log.read_text().splitlines(), run.stderr, run.returncode


def test_uv_installs_the_cpu_build_of_torch_first(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path)
    assert lines == ["pip installer.lock", "uv torch.lock cpu", "uv service.lock", "uv torch.lock cpu"]
    assert (said, status) == ("", 0)


def test_without_the_index_of_pytorch_torch_is_what_pip_would_find(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path, "no-index")
    assert lines == ["pip installer.lock", "uv torch.lock", "uv service.lock", "uv torch.lock"]
    assert "The cpu build of torch cannot be had" in said and status == 0


def test_without_uv_pip_installs(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path, "no-uv")
    assert lines == ["pip torch.lock", "pip service.lock", "pip torch.lock"]
    assert "uv could not install" in said and status == 0


def test_a_failure_is_told(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path, "full")
    assert lines == ["pip installer.lock"]
    assert "could not be installed" in said and status == 1


@pytest.mark.parametrize(
    ("listing", "expected"),
    [
        ("", {}),
        ("global.index-url='file:///a'\n:env:.index-url='file:///b'", {"UV_DEFAULT_INDEX": "file:///b"}),
        (":env:.index-url='file:///b'\nglobal.index-url='file:///a'", {"UV_DEFAULT_INDEX": "file:///b"}),
        ("global.extra-index-url='\\nfile:///a\\nfile:///b'", {"UV_INDEX": "file:///a file:///b"}),
        ("install.find-links='/a /b'\nglobal.cert='/c'", {"UV_FIND_LINKS": "/a,/b", "SSL_CERT_FILE": "/c"}),
        (":env:.index-url=''\ndownload.find-links='/a'\n:env:.disable-pip-version-check='1'", {}),
    ],
)
def test_settings_of_pip_become_those_of_uv(listing: str, expected: dict[str, Any]) -> None:
    assert uv_settings(listing) == {"UV_INDEX_STRATEGY": "unsafe-best-match"} | expected
