"""What the benchmark counts as a wrong picture, on frames that are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.pictures.damaged import DAMAGES, WRITTEN, Tally, written
from benchmarks.pictures.decoders import by_opencv, by_project
from service.commands.timing.samples import sample_frame


@pytest.mark.parametrize("name", WRITTEN)
def test_lost_data_is_wrong_only_where_a_decoder_fills_it_in(name: str) -> None:
    project, opencv, random = Tally(by_project), Tally(by_opencv), np.random.default_rng(0)
    for seed in range(4):
        data = written(sample_frame(seed, 160, 120), name)
        damaged = {kind: damage(data, random) for kind, damage in DAMAGES.items()}
        assert all(one != data for one in damaged.values())
        project.add(data, damaged)
        opencv.add(data, damaged)
    for kind in ("cut", "cut, ended", "more rows"):
        assert project.wrong[kind] == 0, kind
    assert project.refused == opencv.refused == 0
    assert (opencv.wrong["cut, ended"] > 0) == ("JPEG" in name)
