"""What imports what: what users install or copy stands alone, and nothing is undeclared.

Which room may import which is kept by the contracts of import-linter in ``pyproject.toml``; scripts/lint checks them.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.project.sources import CLIENT, FILES, FOLDERS, NODE, ROOT, forbidden_imports, imports_of
from tests.project.test_lock import locked

installed = cache(packages_distributions)
"""The distributions of each top-level module."""


@pytest.mark.parametrize("folder", ["examples", "clients/python/placerec_client", "clients/ros2/placerec_ros"])
def test_what_users_copy_or_install_alone_needs_nothing_of_the_project(folder: str) -> None:
    """The node needs the client, and no other."""
    others = {"benchmarks", "core", "lab", "service", "tests", "examples"} - {folder}
    assert forbidden_imports(folder, others) == []


def test_the_node_imports_what_its_package_declares() -> None:
    """rosdep installs what package.xml names; the client is installed by pip."""
    package = ElementTree.parse(NODE / "package.xml").getroot()
    depends = {str(entry.text).removeprefix("python3-") for entry in package.iter("exec_depend")}
    known = set(sys.stdlib_module_names) | {"placerec_client", "placerec_ros"} | depends
    files = [*(NODE / "placerec_ros").rglob("*.py"), *(NODE / "launch").glob("*.py")]
    used = {name.split(".")[0] for path in files for name, _ in imports_of(path)}
    assert used - known == set()
    assert depends - used == set()


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CLIENT_PROJECT = tomllib.loads((CLIENT / "pyproject.toml").read_text())["project"]
FOR_TYPES = {"numpy", "pillow"}
"""What the client imports for types, and for arrays and images alone: a caller who gives these has it."""

OF_ROS = {NODE, ROOT / "tests/clients/ros2/peer.py", ROOT / "examples/simulator"}
"""What runs in .venv-ros, whose packages are not here."""

EXTRAS = {
    "core/ledger/postgres": {"cluster"},
    "core/maps/formats/mcap": {"bags"},
    "core/index/milvus": {"milvus"},
    "core/store/cluster": {"cluster"},
    "core/recordings": {"bags"},
    "examples": {"bags"},
    "lab": {"lab"},
    "scripts/manifests": {"dev"},
    "service/peers/differences": {"cluster"},
    "service/peers/replica": {"cluster"},
    "service/shared": {"cluster"},
}
"""Folders and modules that may import what an extra brings; tests and benchmarks may import all."""


def allowed(path: Path) -> set[str]:
    """The distributions that a file may import from."""
    if path.is_relative_to(CLIENT):
        texts = [*CLIENT_PROJECT["dependencies"], *CLIENT_PROJECT["optional-dependencies"]["stream"], *FOR_TYPES]
        return {canonicalize_name(Requirement(text).name) for text in texts}
    extras = PROJECT["optional-dependencies"]
    within = [path.with_suffix(""), *path.parents]
    folders = {str(one.relative_to(ROOT)) for one in within if one.is_relative_to(ROOT)}
    chosen = (
        set(extras) if folders & {"benchmarks", "tests"} else set().union(*(EXTRAS.get(one, ()) for one in folders))
    )
    texts = PROJECT["dependencies"] + [text for extra in chosen for text in extras[extra]]
    return {canonicalize_name(Requirement(text).name) for text in texts}


@pytest.mark.thorough
def test_what_is_imported_is_declared() -> None:
    known = (
        set(sys.stdlib_module_names)
        | {Path(folder).name for folder in FOLDERS}
        | {path.stem for path in (ROOT / "examples").glob("*.py")}
    )
    distributions = installed()
    undeclared = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in FILES
        if not any(path.is_relative_to(one) for one in OF_ROS)
        for name, _ in imports_of(path)
        if (top := name.split(".")[0]) not in known
        if not allowed(path) & {canonicalize_name(distribution) for distribution in distributions.get(top, [])}
    }
    assert undeclared == set()


BLOCKED = """
import importlib.abc, pkgutil, sys

class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

blocked, without = set(sys.argv[1].split()), tuple(sys.argv[2].split())
sys.meta_path.insert(0, Blocker())
import core, service
count = 0
for package in (core, service):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not (found.name + ".").startswith(without) and not found.name.endswith("__main__"):
            __import__(found.name)
            count += 1
print(count, *(sorted(blocked & {name.split(".")[0] for name in sys.modules})))
"""


@pytest.mark.thorough
def test_the_service_and_the_core_need_only_what_the_service_lock_has() -> None:
    """Every module is imported, those of an extra apart, while nothing can be imported that the lock leaves out."""
    extra = set(locked("development")) - set(locked("service"))
    blocked = {
        top
        for top, distributions in installed().items()
        if {canonicalize_name(name) for name in distributions} <= extra
    }
    assert {"matplotlib", "PIL", "sklearn", "pytest"} <= blocked
    without = " ".join(f"{folder.replace('/', '.')}." for folder in EXTRAS)
    command = [sys.executable, "-c", BLOCKED, " ".join(blocked), without]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    count, *there = run.stdout.split()
    assert int(count) > 200 and there == []
