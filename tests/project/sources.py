"""The project's Python files and what they import, for the tests of the source."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
CLIENT = ROOT / "clients" / "python"
OF_CLIENT = "clients/python/placerec_client"
NODE = ROOT / "clients" / "ros2"
OF_NODE = "clients/ros2/placerec_ros"
FOLDERS = ("core", "service", "lab", "benchmarks", OF_CLIENT, OF_NODE, "examples", "scripts", "tests")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def syntax_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), path.name)


@cache
def imports_of(path: Path) -> tuple[tuple[str, str | None], ...]:
    """Every import of a file, wherever it stands: the module, and of ``from module import name`` the name.

    Imports within functions and those for types alone count.
    """
    found: list[tuple[str, str | None]] = []
    for node in ast.walk(syntax_of(path)):
        if isinstance(node, ast.Import):
            found += [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{path}: a relative import"
            found += [(node.module, alias.name) for alias in node.names]
    return tuple(found)


def forbidden_imports(folder: str, forbidden: set[str]) -> list[str]:
    """Imports in ``folder`` of a forbidden module or of anything below one."""
    return [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in FILES
        if path.is_relative_to(ROOT / folder)
        for module, imported in imports_of(path)
        for name in [f"{module}.{imported}" if imported else module]
        if any(name == one or name.startswith(one + ".") for one in forbidden)
    ]
