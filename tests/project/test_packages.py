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
    "-m pip config "*) echo "global.find-links='/wheels /more'"; [ ! -e "$LOG.pip" ] || cat "$LOG.pip" ;;
    *--target*)
        [ ! -e "$LOG.no_uv" ] || exit 1
        while [ "$1" != --target ]; do shift; done
        mkdir "$2/bin" && cp "$0" "$2/bin/uv" && echo "pip installer.lock" >>"$LOG" ;;
    *)
        tool=uv; [ "$1" != -m ] || tool=pip
        case "$*" in *--torch-backend*)
            [ ! -e "$LOG.$TORCH_BACKEND" ] || { cat "$LOG.$TORCH_BACKEND" >&2; exit 1; }
            more=" $TORCH_BACKEND" ;;
        esac
        [ "$tool" = pip ] || [ "$UV_FIND_LINKS" = /wheels,/more ] || exit 1
        [ ! -e "$LOG.full" ] || exit 1
        case "$*" in *--no-index*) more="${more:-} without an index" ;; esac
        echo "$tool ${@: -1:1}${more:-}" | sed "s|/.*/||" >>"$LOG" ;;
esac
"""


def installed(folder: Path, backend: str = "cpu", **given: str) -> tuple[list[str], str, int]:
    """What ``packages.py service`` installs, what it says, and its status.

    Args:
        backend: the build of torch.
        given: ``no_uv``: uv cannot be had; ``full``: nothing can be installed; ``cpu``: why uv does not find that build
            of torch; ``pip``: more of pip's configuration.
    """
    stub, log = folder / "python", folder / "log"
    stub.write_text(STUB)
    stub.chmod(0o755)
    log.touch()
    for what, text in given.items():
        Path(f"{log}.{what}").write_text(text)
    code = f"import sys; sys.executable = {str(stub)!r}; from scripts.packages import main; sys.exit(main('service'))"
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("UV_", "PIP_"))}
    environment |= {"LOG": str(log), "TORCH_BACKEND": backend, "PYTHONPATH": str(ROOT)}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300)
    return log.read_text().splitlines(), run.stderr, run.returncode


def test_uv_installs_the_cpu_build_of_torch_first(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path)
    assert lines == ["pip installer.lock", "uv torch.lock cpu", "uv service.lock", "uv torch.lock cpu"]
    assert (said, status) == ("", 0)


def test_without_the_index_of_pytorch_torch_is_what_pip_would_find(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path, cpu="error: no address\n  known")
    assert lines == ["pip installer.lock", "uv torch.lock", "uv service.lock", "uv torch.lock"]
    assert "The cpu build of torch cannot be had" in said and "uv says: error: no address known" in said
    assert status == 0


def test_a_build_of_torch_that_there_is_not_is_refused(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path, cpu="error: invalid value 'cpu' for '--torch-backend'")
    assert lines == ["pip installer.lock"]
    assert "TORCH_BACKEND names no build of torch" in said and status == 1


@pytest.mark.parametrize(
    ("configured", "more"),
    [
        ("global.no-index='true'", " without an index"),
        ("global.no-index='true'\n:env:.no-index='0'", ""),
        ("download.no-index='true'", ""),
    ],
)
def test_uv_asks_no_index_if_pip_is_to_ask_none(tmp_path: Path, configured: str, more: str) -> None:
    lines, _, status = installed(tmp_path, pip=configured)
    assert lines[2] == f"uv service.lock{more}" and status == 0


def test_without_uv_pip_installs(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path, no_uv="")
    assert lines == ["pip torch.lock", "pip service.lock", "pip torch.lock"]
    assert "uv could not install" in said and status == 0


def test_an_image_may_do_without_torch(tmp_path: Path) -> None:
    assert installed(tmp_path, backend="none") == (["pip installer.lock", "uv service.lock"], "", 0)


def test_a_failure_is_reported(tmp_path: Path) -> None:
    lines, said, status = installed(tmp_path, full="")
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
