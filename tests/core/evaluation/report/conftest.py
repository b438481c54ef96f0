from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="package", autouse=True)
def small_charts() -> Iterator[None]:
    """Charts of a quarter of the pixels, which take half the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("core.evaluation.report.charts.DPI", 50)
        yield
