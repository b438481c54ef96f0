from __future__ import annotations

from pathlib import Path

import pytest

from tests.lab.evaluation.report.comparisons import Written, make_comparison, written_page


@pytest.mark.thorough
def test_counts_are_those_of_the_evaluation(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1, retained=range(6), noise=4.0)
    page = written_page(tmp_path / "report", comparison)
    cells = [int(cell.text) for cell in page.named("td") if cell.text and not cell.attributes]
    mean, full = comparison.runs[0].evaluation.thresholds
    expected = [
        number
        for counts in (mean.before, mean.after, full.after)
        for number in (
            counts.true_positives,
            counts.false_positives,
            counts.false_negatives,
            counts.true_negatives,
        )
    ]
    assert cells == expected
    rows = [head.text for head in page.named("th") if head.attributes["scope"] == "row"]
    assert rows[-2] == f"over {mean.threshold:.3f}, the mean score of the queries without a true reference"
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert {"scores-after-system-0.png", "scores-before-system-0.png", "similarity-system-0.png"} <= names


@pytest.mark.thorough
def test_system_is_described(written: Written) -> None:
    page, system = written.page, written.comparison.runs[0].about.name
    section = page.named("section", "run")[0]
    assert section.attributes["id"] == "run-0" and "Somebody, 2020." in section.text
    details = page.named("details")[0]
    for name, value in (("N", "300"), ("layers", "conv3 conv4"), ("identity", f"{system}@0123456789abcdef")):
        assert f"{name}{value}" in details.text
