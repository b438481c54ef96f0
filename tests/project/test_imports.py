"""What imports what: no file in a circle, no crowded folder, nothing undeclared.

Which room may import which is kept by the contracts of import-linter in ``pyproject.toml``; scripts/lint checks them.
"""

from __future__ import annotations

import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tests.project.sources import FILES, FOLDERS, ROOT, forbidden_imports, imports_of

MOST_MODULES = 16


def import_graph(files: Iterable[Path]) -> dict[str, set[str]]:
    """Each file's dotted name (a package's for its ``__init__.py``) and the other files that it imports from."""
    paths = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}
    graph = {}
    for name, path in paths.items():
        imported = {f"{module}.{one}" if f"{module}.{one}" in paths else module for module, one in imports_of(path)}
        graph[name] = (imported & set(paths)) - {name}
    return graph


def circles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """The strongly connected components of more than one file."""
    names = sorted(graph)
    index = {name: number for number, name in enumerate(names)}
    edges = [(index[name], index[other]) for name, others in graph.items() for other in others]
    matrix = coo_array(([1] * len(edges), tuple(zip(*edges, strict=True))), shape=(len(names), len(names)))
    _, components = connected_components(matrix, directed=True, connection="strong")
    members: dict[int, list[str]] = {}
    for name, component in zip(names, components, strict=True):
        members.setdefault(int(component), []).append(name)
    return sorted(found for found in members.values() if len(found) > 1)


def test_a_circle_is_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": {"d"}, "f": {"a"}}
    assert circles(graph) == [["a", "b", "c"], ["d", "e"]]


KNOWN_CROWDS = {"tests/core/storage"}
"""Folders of tests with more modules, to be divided when one of them grows."""


def test_no_files_import_each_other_in_a_circle() -> None:
    graph = import_graph(FILES)
    assert len(graph) > 300
    assert circles(graph) == []


def test_no_folder_is_crowded() -> None:
    modules = Counter(str(path.parent.relative_to(ROOT)) for path in FILES if path.name != "__init__.py")
    crowded = {folder: count for folder, count in modules.items() if count > MOST_MODULES}
    assert set(crowded) <= KNOWN_CROWDS, crowded


def test_examples_know_nothing_of_the_project() -> None:
    """They show what users write, who have the service's address and none of its code."""
    assert forbidden_imports("examples", {"benchmarks", "core", "service", "tests", "training"}) == []


@pytest.mark.parametrize("folder", FOLDERS)
def test_what_is_imported_is_declared(folder: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    developing = folder in ("tests", "benchmarks")
    extras = [name for name in project["optional-dependencies"] if developing or name != "dev"]
    texts = sum((project["optional-dependencies"][name] for name in extras), project["dependencies"])
    declared = {canonicalize_name(Requirement(text).name) for text in texts}
    examples = {path.stem for path in (ROOT / "examples").glob("*.py")}
    known = set(sys.stdlib_module_names) | set(FOLDERS) | examples
    distributions = packages_distributions()
    undeclared = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in FILES
        if path.is_relative_to(ROOT / folder)
        for name, _ in imports_of(path)
        if (top := name.split(".")[0]) not in known
        if not declared & {canonicalize_name(distribution) for distribution in distributions.get(top, [])}
    }
    assert undeclared == set()
