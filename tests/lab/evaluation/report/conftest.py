from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from lab.evaluation import ScalePoint, SeverityCurve, SizePoint
from lab.evaluation.data.published import PublishedRecall
from tests.lab.evaluation.report.comparisons import Written, make_comparison, page_of


@pytest.fixture(scope="package", autouse=True)
def small_charts() -> Iterator[None]:
    """Charts of a quarter of the pixels, which take half the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lab.evaluation.report.charts.DPI", 50)
        yield


@pytest.fixture(scope="package")
def written(small_charts: None, tmp_path_factory: pytest.TempPathFactory) -> Written:
    folder = tmp_path_factory.mktemp("report")
    made = make_comparison(folder, systems=2, retained=range(6), noise=6)
    comparison = replace(
        made,
        runs=[made.runs[0], replace(made.runs[1], elsewhere=True)],
        published=[PublishedRecall("made", "Ghost <net>", (0.5, 0.75), "Some paper, Table 1", 2024)],
        scalability=[ScalePoint("system-0", n, n, 0.9 / n, 0.8, 0.0) for n in (1, 2)],
        map_sizes=[SizePoint("system-0", n, 4, 3, 0.5, 0.0625, 0.1875, 0.75, 0.25, 0.125) for n in (1, 4)],
        severity=[SeverityCurve("a/b <c>", "unknown", [0.0, 1.0], "", [0.9, 0.5], [0.8, 0.3])],
        regions=lambda path: [(0.0, 0.25, 0.5, 1.0)],
    )
    html, page = page_of(folder / "report", comparison)
    return Written(comparison, folder / "report", html, page)
