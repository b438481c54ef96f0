"""The licences of everything that is shipped: packages by the lock files, networks, and libraries of the console.

    .venv/bin/python -m scripts.licences texts [PROFILE]   # all texts in one file, which an image carries
    .venv/bin/python -m scripts.licences page              # writes the table of docs/reference/licences.md anew

Names and texts are those that the installed packages state, so that it runs in the environment that is described.  Only
the standard library is used.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from scripts.inventory import PROFILES, ROOT, components_of

MODELS = ROOT / "core/models"
VENDOR = ROOT / "service/console/vendor"
PAGE = ROOT / "docs/reference/licences.md"
BEGIN, END = "<!-- begin of the packages -->\n", "<!-- end of the packages -->\n"
LONGEST = 60
"""Letters of a licence's name; what is longer in a package's metadata is its text."""

_TEXT = re.compile(r"licen[cs]e|copying|notice|third.?party", re.IGNORECASE)
_NO_TEXT = {".py", ".pyc", ".pyi", ".so", ".js", ".json", ".h"}
_KNOWN = {
    "BSD License": "BSD",
    "MIT License": "MIT",
    "Apache Software License": "Apache-2.0",
    "Apache 2.0": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "Apache License, Version 2.0": "Apache-2.0",
    "3-Clause BSD License": "BSD-3-Clause",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "ISC License (ISCL)": "ISC",
}


@dataclass(frozen=True)
class Licence:
    """The licence of a part that is shipped.

    version: empty for a package that is locked for other systems alone.
    texts: by the path in the package.
    """

    part: str
    version: str
    name: str
    texts: tuple[tuple[str, str], ...]


def licences_of(profile: str) -> list[Licence]:
    """Those of the packages and libraries of a profile by name; all that is locked is named.

    A package that is not installed here, for its marker or because an image leaves it out, is named without a text.
    """
    scripts = {entry["name"]: entry for entry in json.loads((VENDOR / "lock.json").read_text())}
    found = []
    for one in components_of(profile):
        if one.name in scripts:
            names = [name for name in scripts[one.name]["files"] if name.endswith(".LICENSE")]
            texts = tuple((name, (VENDOR / name).read_text()) for name in names)
            found.append(Licence(one.name, one.version, scripts[one.name]["licence"], texts))
            continue
        try:
            installed = distribution(one.name)
        except PackageNotFoundError:
            found.append(Licence(one.name, "", f"not here{f'; only where {one.marker}' if one.marker else ''}", ()))
        else:
            found.append(Licence(one.name, installed.version, name_of(installed), tuple(texts_of(installed))))
    return found


def name_of(package: Distribution) -> str:
    """The licence as the metadata of a package name it: an SPDX expression, a short name, or classifiers.

    Raises:
        ValueError: it names none.
    """
    about = package.metadata
    stated = [*(about.get_all("License-Expression") or ()), *(about.get_all("License") or ())]
    expression = str(stated[0]) if stated else ""
    if not expression or len(expression) > LONGEST or "\n" in expression or expression in ("UNKNOWN", "Dual License"):
        kinds = [line.rpartition(" :: ")[2] for line in about.get_all("Classifier") or () if line.startswith("License")]
        expression = " and ".join(_KNOWN.get(kind, kind) for kind in kinds)
    if not expression:
        expression = next((found for _, text in texts_of(package) if (found := kind_of(text))), "")
    if not expression:
        raise ValueError(f"{package.metadata['Name']} names no licence")
    return _KNOWN.get(expression, expression)


def kind_of(text: str) -> str:
    """The licence that a text is, as far as it says so itself; else empty."""
    if "Permission is hereby granted, free of charge" in text:
        return "MIT"
    if "Redistribution and use in source and binary forms" in text:
        return "BSD-3-Clause" if "Neither the name" in text else "BSD-2-Clause"
    return "Apache-2.0" if "Apache License" in text else ""


def texts_of(package: Distribution) -> Iterator[tuple[str, str]]:
    """The paths and texts of a package's licences and notices, of libraries within its files too."""
    for path in sorted(package.files or (), key=str):
        if _TEXT.search(path.name) and path.suffix not in _NO_TEXT and "tests" not in path.parts:
            file = Path(str(package.locate_file(path)))
            if file.is_file() and (text := file.read_text(errors="replace").strip()):
                yield str(path), text


def networks() -> list[Licence]:
    """Those of the packaged networks."""
    xfeat = tuple((name, (MODELS / name).read_text()) for name in ("LICENSE-xfeat.txt", "NOTICE"))
    return [Licence("xfeat.onnx", "", "Apache-2.0", xfeat)]


def document(found: Iterable[Licence]) -> str:
    """All of it as one text."""
    parts = [
        "What placerec is shipped with, and its licences. placerec itself has none yet: all rights are reserved.\n"
        "Packages of the base system have theirs in /usr/share/doc.\n"
    ]
    for one in found:
        title = f"{one.part} {one.version}".strip()
        parts.append(f"{'=' * 80}\n{title}\n{one.name}\n{'=' * 80}\n")
        parts += [f"--- {path}\n\n{text.strip()}\n" for path, text in one.texts]
        if not one.texts:
            parts.append("(no text comes with it)\n")
    return "\n".join(parts)


def table() -> str:
    """The rows of the page: every locked package of the images, and which images have it."""
    all_images = {one.part for one in licences_of("service")}
    of_images = {"cluster": licences_of("replica"), "bags": licences_of("bags")}
    rows = ["| package | licence | images |", "|---|---|---|"]
    packages = {one.part: one for found in of_images.values() for one in found}
    for one in sorted(packages.values(), key=lambda one: one.part):
        having = ", ".join(image for image, found in of_images.items() if one in found)
        images = "none" if not one.version else "all" if one.part in all_images else having
        rows.append(f"| {one.part} | {one.name} | {images} |")
    return "\n".join(rows) + "\n"


def page(text: str) -> str:
    """The page with the table as it is now."""
    before, _, rest = text.partition(BEGIN)
    return before + BEGIN + "\n" + table() + "\n" + END + rest.partition(END)[2]


def main() -> int:
    parser = argparse.ArgumentParser(description="The licences of everything that is shipped.")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("page", help="write the table of docs/reference/licences.md anew")
    texts = commands.add_parser("texts", help="print all texts")
    texts.add_argument("profile", nargs="?", choices=PROFILES, default="service")
    given = parser.parse_args()
    if given.command == "page":
        PAGE.write_text(page(PAGE.read_text()))
    else:
        sys.stdout.write(document([*licences_of(given.profile), *networks()]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
