"""The package of the ROS 2 node: what is built of it, as colcon and pip do by setuptools, and its versions."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from placerec_client.version import VERSION
from placerec_ros.parameters import PARAMETERS
from tests.project.sources import NODE, ROOT

VENV = ROOT / ".venv-ros"


@pytest.mark.thorough
def test_what_is_built_is_a_package_of_ros(tmp_path: Path) -> None:
    shutil.copytree(NODE, tmp_path / "source", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    words = ["-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path)]
    subprocess.run([sys.executable, *words, str(tmp_path / "source")], check=True, cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        points = next(archive.read(name).decode() for name in names if name.endswith("entry_points.txt"))
    shared = {name.partition(".data/data/share/")[2] for name in names if ".data/data/share/" in name}
    assert shared == {
        "ament_index/resource_index/packages/placerec_ros",
        "placerec_ros/package.xml",
        "placerec_ros/launch/placerec.launch.py",
        "placerec_ros/config/placerec.yaml",
    }
    assert "placerec_node = placerec_ros.node:main" in points
    modules = {path.name for path in (NODE / "placerec_ros").glob("*.py")}
    assert {name.partition("/")[2] for name in names if name.startswith("placerec_ros/")} == modules


@pytest.mark.thorough
def test_colcon_builds_and_tests_it(tmp_path: Path) -> None:
    """As on a robot: a workspace with the package, its tests in clients/ros2/test, and the program that it installs."""
    if not (VENV / "bin" / "colcon").exists() or not (VENV / "installed").exists():
        pytest.skip("there is no .venv-ros: ROS's wheels cannot be had for this Python and machine (environment ros)")
    shutil.copytree(NODE, tmp_path / "src" / "placerec_ros", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    path = f"{VENV / 'bin'}:/usr/bin:/bin"
    environment = {"PATH": path, "AMENT_PREFIX_PATH": str(VENV), "HOME": str(tmp_path), "ROS_LOG_DIR": str(tmp_path)}

    def colcon(*words: str) -> str:
        command = [str(VENV / "bin" / "colcon"), *words]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout

    colcon("build")
    assert (tmp_path / "install" / "local_setup.sh").exists()
    colcon("test", "--return-code-on-test-failure")
    said = colcon("test-result")
    assert "0 errors, 0 failures" in said and not said.startswith("Summary: 0 tests"), said


def test_versions_are_those_of_the_client() -> None:
    version = VERSION
    assert ElementTree.parse(NODE / "package.xml").getroot().findtext("version") == version
    assert f'version="{version}"' in (NODE / "setup.py").read_text()


def test_the_files_for_launch_name_parameters_of_the_node() -> None:
    text = (NODE / "config" / "placerec.yaml").read_text()
    given = yaml.safe_load(text)["/**"]["ros__parameters"]
    known = {one.name: type(one.default) for one in PARAMETERS}
    assert {name: type(value) for name, value in given.items()} == {name: known[name] for name in given}
    launch = (NODE / "launch" / "placerec.launch.py").read_text()
    compile(launch, "placerec.launch.py", "exec")
    assert 'executable="placerec_node"' in launch
