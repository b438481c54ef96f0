"""Everything that is shipped has its licence named, and its text in the file that an image carries."""

from __future__ import annotations

import json

import pytest

from scripts.licences import VENDOR, document, kind_of, licences_of, networks
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
    assert without <= {"flatbuffers"}, "a wheel that was known to have a text has none"
    text = document([*licences_of("service"), *networks()])
    for words in ("Free Software Foundation", "GNU LESSER GENERAL PUBLIC LICENSE", "FFmpeg", "OpenBLAS", "xfeat.onnx"):
        assert words in text, words


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
