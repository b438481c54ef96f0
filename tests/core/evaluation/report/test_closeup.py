from __future__ import annotations

from pathlib import Path

from core.evaluation.report.closeup import closeup
from core.evaluation.report.theme import Cast
from core.evaluation.report.thumbnails import Thumbnails
from tests.core.evaluation.report.comparisons import make_comparison, read_page


def test_counts_are_those_of_the_evaluation(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1, kept=range(6), noise=4.0)
    run = comparison.runs[0]
    made = closeup(comparison, run, Cast([run]).runs[0], "stem", Thumbnails())
    page = read_page(made.html)
    cells = [int(cell.text) for cell in page.named("td")]
    mean, full = run.evaluation.thresholds
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
    assert rows[1] == f"over {mean.threshold:.3f}, the mean score of the queries without a true reference"
    assert sorted(made.files) == ["scores-after-stem.png", "scores-before-stem.png", "similarity-stem.png"]


def test_system_is_described(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1)
    run = comparison.runs[0]
    html = closeup(comparison, run, Cast([run]).runs[0], "stem", Thumbnails()).html
    page = read_page(html)
    assert "Somebody, 2020." in html
    names, values = ([one.text for one in page.named(tag)] for tag in ("dt", "dd"))
    assert dict(zip(names, values, strict=True)) == {
        "N": "300",
        "layers": "conv3 conv4",
        "identity": "system-0@0123456789abcdef",
    }
    assert page.named("section")[0].attributes["id"] == "run-0"
