from __future__ import annotations

from pathlib import Path

import pytest

from tests.lab.evaluation.report.comparisons import make_comparison, written_page


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
