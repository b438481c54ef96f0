"""Nothing leaves the machine but answers, and nothing is written but where it was asked for: the kernel is asked.

Each program runs in a home and a temporary folder of its own, with the variables that switch reports off set the wrong
way; what it says to others and where it writes is seen by :mod:`tests.watch`.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from core.silence import SWITCHES
from tests.lab.conversion.onnx_writer import MAPS, onnx_network
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import ROOT, Server
from tests.watch import CACHES, PROXIES, Watch, missing

MACHINES_THAT_BUILD = (
    *("CI", "TF_BUILD", "GITHUB_ACTIONS", "GITLAB_CI", "CIRCLECI", "TRAVIS", "JENKINS_URL", "CODEBUILD_BUILD_ID"),
    *("BUILDKITE", "TEAMCITY_VERSION", "APPVEYOR", "BITBUCKET_BUILD_NUMBER", "SYSTEM_TEAMFOUNDATIONCOLLECTIONURI"),
)
"""Variables by which ONNX Runtime knows a machine that builds and tests, where it reports nothing by itself."""


@pytest.fixture
def watch(tmp_path: Path) -> Watch:
    if reason := missing():
        pytest.skip(f"nobody can watch what a program does: {reason}")
    return Watch(tmp_path)


def wrapped(watch: Watch, folder: Path) -> list[str]:
    """The words before a command that is watched, with a home and a temporary folder in ``folder``.

    The command is told of no cache elsewhere, and of no proxy, whatever the machine has; nor that a machine tests it,
    since what is silent there would be so for another reason.
    """
    places = {"HOME": folder / "home", "XDG_CACHE_HOME": folder / "home" / "cache", "TMPDIR": folder / "temporary"}
    for place in places.values():
        place.mkdir(parents=True, exist_ok=True)
    wrong = dict.fromkeys(SWITCHES, "0") | {"FASTAPI_OTEL_AUTO_CONFIGURE": "true"}
    unset = [word for name in (*MACHINES_THAT_BUILD, *CACHES, *PROXIES) for word in ("-u", name)]
    return ["/usr/bin/env", *unset, *(f"{name}={value}" for name, value in (places | wrong).items()), *watch.wrapper]


def written(watch: Watch, folder: Path, *own: Path) -> set[str]:
    """Files written outside ``own``, but for what Python and Numba compile once for this checkout.

    In the temporary folder files may have been, but none is left.
    """
    left = {str(path) for path in (folder / "temporary").rglob("*")}
    return left | {path for path in watch.written([*own, folder / "temporary"]) if "/__pycache__" not in path}


def test_what_reports_would_be_seen(watch: Watch, tmp_path: Path) -> None:
    """ONNX Runtime as it comes; if this fails, it reports no longer, and need not be silenced."""
    with watch:
        command = [*wrapped(watch, tmp_path), sys.executable, "-c", "import onnxruntime"]
        subprocess.run(command, check=True)
    assert any(path.startswith(str(tmp_path / "home")) for path in written(watch, tmp_path)), watch.seen


@pytest.mark.thorough
def test_the_service(watch: Watch, tmp_path: Path) -> None:
    with watch:
        server = Server(tmp_path / "server", wrapper=wrapped(watch, tmp_path))
        try:
            use(server.wait())
        finally:
            status = server.stop()
    assert status == 0
    assert written(watch, tmp_path, server.data_dir) == set()
    assert watch.told() == set()
    assert watch.listened() == {f"127.0.0.1:{server.port}"}


def use(server: Server) -> None:
    """Ask for what loads most of what there is."""
    server.create_map("lab", keep="image")
    for number in range(3):
        assert server.enrol("lab", f"p{number}", jpeg(number), x=number, y=0, sequence="s").status_code == 201
    assert server.query("lab", jpeg(1), verify="always")["matches"][0]["place"]["id"] == "p1"
    session = server.client.post("/v1/maps/lab/sessions", json={}).json()["id"]
    sent = server.client.post(
        f"/v1/maps/lab/sessions/{session}/frames", content=jpeg(2), headers={"Content-Type": "image/jpeg"}
    )
    assert sent.status_code == 200, sent.text
    for path in ("/docs", "/metrics", "/console", "/v1/maps/lab/export", "/v1/maps/lab/health"):
        assert server.client.get(path).status_code == 200, path


@pytest.mark.thorough
@pytest.mark.parametrize("where", ["--url", "--data-dir"])
def test_commands(watch: Watch, tmp_path: Path, server: Server, where: str) -> None:
    """On a map of a service, whose address is all that they know, and on a data directory."""
    (tmp_path / "pictures").mkdir()
    for number in range(2):
        (tmp_path / "pictures" / f"{number}.jpg").write_bytes(encoded(scene(number)))
    address = f"http://127.0.0.1:{server.port}"
    words = ("enrol", tmp_path / "pictures", "--map", "enrolled-in-silence", "--create")
    run(watch, tmp_path, *words, where, address if where == "--url" else tmp_path / "data")
    assert watch.told() == ({f"127.0.0.1:{server.port}"} if where == "--url" else set())
    assert written(watch, tmp_path, tmp_path / "data") == set()


@pytest.mark.thorough
def test_a_child_that_reads_what_others_published(watch: Watch, tmp_path: Path) -> None:
    (tmp_path / "small.onnx").write_bytes(onnx_network().SerializeToString())
    (tmp_path / "small.json").write_text(MAPS.model_dump_json())
    words = ("model", "import", tmp_path / "small.onnx", "--description", tmp_path / "small.json", "--name", "small")
    run(watch, tmp_path, *words, "--models-dir", tmp_path / "models")
    assert watch.told() == set()
    assert written(watch, tmp_path, tmp_path / "models") == set()


def run(watch: Watch, folder: Path, *words: object) -> None:
    """Run ``placerec``."""
    with watch:
        command = [*wrapped(watch, folder), sys.executable, "-m", "service.commands", *map(str, words)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
