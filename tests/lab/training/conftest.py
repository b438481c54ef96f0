"""Pictures to train on, made here; one thread, several tests run at a time and would wait for the threads of others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_limits


@pytest.fixture(autouse=True, scope="package")
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with threadpool_limits(1):
        yield
    torch.set_num_threads(before[0])
    cv2.setNumThreads(before[1])


@pytest.fixture(scope="package")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sources of small pictures, and three day/night cameras."""
    folder = tmp_path_factory.mktemp("photographs")
    generator = np.random.default_rng(0)
    names = [f"{source}/{n:03}.png" for source in ("roads", "rooms") for n in range(60)]
    names += [f"day_night/{camera}/{light}_{n}.png" for camera in "abc" for light in ("day", "night") for n in range(2)]
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        coarse = generator.integers(0, 256, (9, 12, 3), np.uint8)
        cv2.imwrite(str(path), cv2.resize(coarse, (96, 72), interpolation=cv2.INTER_CUBIC))
    return folder
