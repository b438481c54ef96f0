"""The direction of imports, and what no module may do."""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
FOLDERS = ("core", "service", "training", "benchmarks", "examples", "tests")
HTTP = {"fastapi", "starlette", "uvicorn", "httpx", "http", "python_multipart", "aiohttp", "requests"}
PICKLING = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
LONGEST = 400  # lines

FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


@cache
def syntax_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), path.name)


def imports_of(path: Path) -> Iterator[str]:
    """Full dotted names of all that a module imports, at its top or within a function."""
    for node in ast.walk(syntax_of(path)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{path}: a relative import"
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


def offenders(folder: str, forbidden: set[str]) -> list[str]:
    """Imports in ``folder`` of a forbidden module or of anything below one."""
    return [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in FILES
        if path.is_relative_to(ROOT / folder)
        for name in imports_of(path)
        if any(name == module or name.startswith(module + ".") for module in forbidden)
    ]


def test_the_packages_are_found() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in FILES} >= {"core", "service", "training", "tests"}


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("core", {"service", "training", "benchmarks", "examples", "tests"} | HTTP),
        ("core", {"typer", "click", "rich", "prometheus_client"}),
        (
            "core/storage",
            {"torch", "numba", "cv2", "core.method.encoder", "core.method.catalogue", "core.networks.network"},
        ),
        ("service", {"training", "benchmarks", "examples", "tests"}),
        ("training", {"service", "benchmarks", "tests"}),
        ("examples", {"core", "service", "training", "tests"}),
    ],
)
def test_imports_go_one_way(folder: str, forbidden: set[str]) -> None:
    assert offenders(folder, forbidden) == []


def test_the_mathematics_knows_no_storage() -> None:
    mathematics = [path for path in FILES if path.parent == ROOT / "core"]
    known = [
        f"{path.name} imports {name}"
        for path in mathematics
        for name in imports_of(path)
        if name.startswith("core.storage") or name == "sqlite3"
    ]
    assert mathematics and known == []


@pytest.mark.parametrize("folder", FOLDERS)
def test_what_is_imported_is_declared(folder: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    developing = folder in ("tests", "benchmarks")
    texts = project["dependencies"] + (project["optional-dependencies"]["dev"] if developing else [])
    declared = {canonicalize_name(Requirement(text).name) for text in texts}
    examples = {path.stem for path in (ROOT / "examples").glob("*.py")}
    known = set(sys.stdlib_module_names) | set(FOLDERS) | examples
    distributions = packages_distributions()
    undeclared = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in FILES
        if path.is_relative_to(ROOT / folder)
        for name in imports_of(path)
        if (top := name.split(".")[0]) not in known
        if not declared & {canonicalize_name(distribution) for distribution in distributions.get(top, [])}
    }
    assert undeclared == set()


def test_nothing_reads_a_pickle() -> None:
    assert [line for folder in FOLDERS for line in offenders(folder, PICKLING | {"torch.load"})] == []
    calls = []
    for path in FILES:
        for node in ast.walk(syntax_of(path)):
            if isinstance(node, ast.Attribute) and ast.unparse(node) in ("torch.load", "np.lib.format.read_array"):
                calls.append(f"{path.relative_to(ROOT)}:{node.lineno} {ast.unparse(node)}")
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
                calls.append(f"{path.relative_to(ROOT)}:{node.lineno} allow_pickle")
    assert calls == []


RUNNING = {
    "eval", "exec", "compile", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "torch.load",
    "torch.jit.load", "torch.hub.load", "torch.package.PackageImporter", "cv2.FileStorage", "tarfile.open",
    "shutil.unpack_archive", "np.lib.format.read_array", "numpy.lib.format.read_array", "pandas.read_pickle",
    "scipy.io.loadmat", "loadmat", "importlib.import_module", "__import__",
}  # fmt: skip
"""Calls by which bytes that were read could run, or be laid out as files."""


@pytest.mark.parametrize("folder", ["core", "service", "training"])
def test_nothing_runs_what_it_reads(folder: str) -> None:
    """What is parsed is parsed by readers that make values and nothing else; weights come from safetensors."""
    calls = []
    for path in FILES:
        if not path.is_relative_to(ROOT / folder):
            continue
        for node in ast.walk(syntax_of(path)):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                shell = any(word.arg == "shell" for word in node.keywords)
                if name in RUNNING or shell or name.endswith((".extractall", ".extract")):
                    calls.append(f"{path.relative_to(ROOT)}:{node.lineno} {name}")
    assert calls == []


def test_no_file_is_too_long() -> None:
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in FILES}
    assert {path: length for path, length in lengths.items() if length > LONGEST} == {}
