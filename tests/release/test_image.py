"""The image, without a container engine: its commands can be read, it leaves out the right files, builds compare."""

from __future__ import annotations

import hashlib
import io
import json
import re
import subprocess
import tarfile
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from scripts.layers import compare
from tests.project.sources import ROOT
from tests.project.test_container import final_stage, instructions

RUNS = [argument for name, argument in instructions() if name == "RUN"]
FIND = re.compile(r"find \. -type f -regex '[^']+' -delete")


@pytest.mark.parametrize("command", RUNS, ids=lambda command: command[:40])
def test_a_shell_can_read_every_command(command: str) -> None:
    subprocess.run(["sh", "-n", "-c", command], check=True)


def test_the_program_of_the_image_is_installed_by_it() -> None:
    (program,) = json.loads(final_stage()["ENTRYPOINT"])
    assert program in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert json.loads(final_stage()["CMD"]) == ["serve"]


def test_programs_of_a_build_are_those_of_the_checkout() -> None:
    for command in RUNS:
        for module in re.findall(r"python -m ((?:service|scripts|core)[\w.]+)", command):
            assert (ROOT / module.replace(".", "/")).with_suffix(".py").is_file(), module
        for script in re.findall(r"python (scripts/\S+\.py)", command):
            assert (ROOT / script).is_file(), script


def test_only_what_builds_and_tests_need_is_left_out(tmp_path: Path) -> None:
    kept = ("a.py", "b.so", "libc.so.1", "data/c.json", "d.txt", "e.onnx", "f.pem", "header", "g.h5", "types.pyc")
    gone = ("a.pyi", "b.h", "c.hpp", "deep/d.cc", "e.pyx", "f.pxd", "g.a", "h.c", "i.cpp", "j.cmake")
    for name in (*kept, *gone):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (command,) = [found for run in RUNS for found in FIND.findall(run)]
    subprocess.run(["sh", "-c", command], cwd=tmp_path, check=True)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert left == set(kept)


def test_bytecode_is_valid_whatever_time_files_have() -> None:
    """A build that sets all times to one (``--timestamp``) would leave other bytecode stale."""
    compiling = [part for run in RUNS for part in run.split("&&") if "compileall" in part]
    assert len(compiling) == 2 and all("--invalidation-mode unchecked-hash" in part for part in compiling)
    times = [argument for name, argument in instructions() if name == "ARG" and "SOURCE_DATE_EPOCH" in argument]
    assert len(times) == 2 and len(set(times)) == 1


def image(folder: Path, layers: list[Mapping[str, bytes]]) -> Path:
    """An image as buildah writes it to a folder, as far as it is compared."""
    folder.mkdir()
    described = []
    for files in layers:
        written = io.BytesIO()
        with tarfile.open(fileobj=written, mode="w") as archive:
            for name, content in files.items():
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
        digest = hashlib.sha256(written.getvalue()).hexdigest()
        (folder / digest).write_bytes(written.getvalue())
        described.append({"digest": f"sha256:{digest}"})
    (folder / "manifest.json").write_text(json.dumps({"layers": described}))
    return folder


LAYERS: list[Mapping[str, bytes]] = [{"etc/base": b"1"}, {"opt/a.py": b"a", "opt/loop.1.nbc": b"x"}]


@pytest.mark.parametrize(
    ("layers", "status", "said"),
    [
        (LAYERS, 0, "layer 1, 0.0 MB: alike"),
        ([LAYERS[0], {"opt/a.py": b"a", "opt/loop.1.nbc": b"y"}], 0, "0 files differ, and 1 caches"),
        ([LAYERS[0], {"opt/a.py": b"b", "opt/loop.1.nbc": b"x"}], 1, "opt/a.py"),
        ([LAYERS[0], {**LAYERS[1], "tmp/log": b""}], 1, "tmp/log"),
        (LAYERS[:1], 1, "different numbers of layers"),
    ],
    ids=["alike", "cache", "content", "more", "layers"],
)
def test_two_builds_are_compared(
    layers: list[Mapping[str, bytes]], status: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(image(tmp_path / "one", LAYERS), image(tmp_path / "other", layers)) == status
    assert said in capsys.readouterr().out
