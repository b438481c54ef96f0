"""Damaged pictures: a short run of what ``scripts/fuzz images`` does for hours."""

from __future__ import annotations

import math
import os
from collections import Counter

import pytest

from core.errors import InvalidImage
from core.frames.exif import read_pose_and_time
from core.frames.images import Limits, decode
from tests.fuzz import images
from tests.fuzz.pictures.mutations import KINDS, mutant
from tests.fuzz.pictures.originals import originals
from tests.service.server import Server

ORIGINALS = originals()
SECONDS = float(os.environ.get("FUZZ_SECONDS", "0"))
"""A longer run; 0: a few pictures."""


def test_a_mutant_is_made_again_by_its_number() -> None:
    assert [mutant(3, index, ORIGINALS) for index in range(50)] == [mutant(3, index, ORIGINALS) for index in range(50)]
    assert mutant(3, 7, ORIGINALS).data != mutant(4, 7, ORIGINALS).data


def test_every_original_is_sound_but_the_animation() -> None:
    for original in ORIGINALS:
        if "animated" in original.name:
            with pytest.raises(InvalidImage, match="animation"):
                decode(original.data)
        else:
            assert decode(original.data).any(), original.name


@pytest.mark.thorough
def test_damaged_pictures_are_decoded_or_refused() -> None:
    ends, kinds = Counter[str](), set()
    for index in range(1500):
        made = mutant(11, index, ORIGINALS)
        kinds.add(made.kind)
        read_pose_and_time(made.data)
        try:
            decode(made.data, Limits(max_pixels=1_000_000))
            ends["decoded"] += 1
        except InvalidImage as error:
            ends[type(error).__name__] += 1
    assert kinds == set(KINDS)
    assert min(ends[name] for name in ("decoded", "TruncatedImage", "NotAnImage", "UnsupportedFormat")) > 20, ends


@pytest.mark.thorough
def test_the_service_answers_each_and_stands_as_it_stood(fuzzed: Server) -> None:
    url, many = str(fuzzed.client.base_url), 10**6 if SECONDS else 120
    report = images.run(url, fuzzed.process.pid, ORIGINALS, seed=5, count=many, threads=3, seconds=SECONDS or math.inf)
    assert report.wrong == [] and report.complaints == [], report.table()
    assert {200, 422} <= {sent.status for sent in report.sent}
