"""A public class has a name of its own: no second module of the packages defines a class of that name."""

from __future__ import annotations

import ast
from collections import defaultdict

from tests.project.sources import FILES, ROOT, module_of, syntax_of

ROOMS = ("core", "service", "lab", "benchmarks")
SHARED = {
    **dict.fromkeys(
        ("Cameras", "Counterparts", "Plan", "Transfer"),
        ("core.ledger", "core.maps"),  # the class that implements an interface, and the interface
    ),
    **dict.fromkeys(("Exporter", "Map", "Snapshot"), ("core.maps", "core.storage")),  # likewise
}
"""Names that several modules define, with the packages of those modules."""


def test_no_two_modules_define_public_classes_of_one_name() -> None:
    modules = defaultdict(list)
    for path in FILES:
        if any(path.is_relative_to(ROOT / room) for room in ROOMS):
            for node in syntax_of(path).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    modules[node.name].append(module_of(path))
    assert len(modules) > 500
    several = {name: found for name, found in modules.items() if len(found) > 1}
    packages = {name: tuple(".".join(one.split(".")[:2]) for one in found) for name, found in several.items()}
    assert packages == SHARED, {name: found for name, found in several.items() if packages[name] != SHARED.get(name)}
