"""Everything that is shipped has its licence named, and its text in the file that an image carries."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest

from scripts.licences import PAGE, VENDOR, document, kind_of, licences_of, networks, page
from tests.project.sources import ROOT
from tests.project.test_lock import locked


@pytest.mark.parametrize("profile", ["service", "replica"])
def test_every_locked_package_and_library_is_named(profile: str) -> None:
    found = {one.part: one for one in licences_of(profile)}
    libraries = {entry["name"] for entry in json.loads((VENDOR / "lock.json").read_text())}
    assert set(found) == {*locked(profile), "torch", *libraries}
    for name, one in found.items():
        if one.version:
            assert one.name and len(one.name) < 80, name
        else:
            assert locked(profile)[name].marker is not None, f"{name} is not installed"


@pytest.mark.thorough
def test_texts_come_with_what_is_installed() -> None:
    without = {one.part for one in licences_of("replica") if one.version and not one.texts}
    assert without <= {"flatbuffers", "obstore", "opencensus-context"}, "a wheel that was known to have a text has none"
    text = document([*licences_of("service"), *networks()])
    for words in ("Free Software Foundation", "GNU LESSER GENERAL PUBLIC LICENSE", "FFmpeg", "OpenBLAS", "xfeat.onnx"):
        assert words in text, words


@pytest.mark.thorough
def test_the_page_is_the_lock_s() -> None:
    """``python -m scripts.licences page`` writes the table."""
    assert page(PAGE.read_text()) == PAGE.read_text()


def test_licences_that_oblige_are_said_to_be_there() -> None:
    text = PAGE.read_text()
    before, _, table = text.partition("<!-- begin")
    for name, licence in re.findall(r"^\| (\S+) \| ([^|]*GPL[^|]*) \|", table, re.MULTILINE):
        assert name in before or name.partition("-")[0] in before, f"{name} is under {licence.strip()}"


def test_the_image_writes_the_file_by_the_script() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "scripts.licences", "texts", "service"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    dockerfile = (ROOT / "docker/Dockerfile").read_text()
    assert dockerfile.count("RUN python -m scripts.licences texts ${PROFILE} >/THIRD-PARTY.txt") == 2
    for stage in ("licences", "licences-without-torch"):
        assert f"COPY --from={stage} /THIRD-PARTY.txt /usr/share/doc/placerec/" in dockerfile
    assert "/usr/share/doc/placerec/THIRD-PARTY.txt" in PAGE.read_text()


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("Permission is hereby granted, free of charge, to any person", "MIT"),
        ("Redistribution and use in source and binary forms … Neither the name", "BSD-3-Clause"),
        ("Redistribution and use in source and binary forms", "BSD-2-Clause"),
        ("Apache License\nVersion 2.0", "Apache-2.0"),
        ("All rights reserved", ""),
    ],
)
def test_a_text_says_which_licence_it_is(text: str, kind: str) -> None:
    assert kind_of(text) == kind


def test_the_readme_says_what_is_licensed_and_what_is_not() -> None:
    text = (ROOT / "README.md").read_text()
    assert "docs/reference/licences.md" in text and "no licence" in text.lower()
