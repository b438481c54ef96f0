"""Building a package in the checkout leaves nothing there that Git would take for the project's."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.project.sources import CLIENT, ROOT


@pytest.mark.skipif(shutil.which("git") is None, reason="Git is not installed")
def test_git_sees_nothing_of_a_build(tmp_path: Path) -> None:
    checkout, wheels = tmp_path / "checkout", tmp_path / "wheels"
    shutil.copytree(CLIENT, checkout / CLIENT.name, ignore=shutil.ignore_patterns("*.egg-info", "build"))
    shutil.copy(ROOT / ".gitignore", checkout)

    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", *words], cwd=checkout, env=environment, check=True, capture_output=True, text=True
        )
        return done.stdout

    git("init", "--quiet")
    git("add", ".")
    words = ["-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(wheels)]
    subprocess.run([sys.executable, *words, f"./{CLIENT.name}"], check=True, cwd=checkout)
    assert list(wheels.glob("*.whl")) and (checkout / CLIENT.name / "build").is_dir()
    assert git("ls-files", "--others", "--exclude-standard") == ""
