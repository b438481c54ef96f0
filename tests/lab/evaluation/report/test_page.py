from __future__ import annotations

import errno
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.errors import StorageFailure, StorageFull
from core.frames.traverses import tolerance_truth
from lab.evaluation import SeverityCurve
from lab.evaluation.report import page as page_module
from lab.evaluation.report import write_report
from lab.evaluation.report.page import write_files
from lab.evaluation.report.theme import DARK, LIGHT, variables
from tests.lab.evaluation.report.comparisons import Written, make_comparison, make_run, page_of, write_images


@pytest.mark.thorough
def test_numbers_of_the_page_are_the_figures_passed_in(written: Written) -> None:
    comparison, page = written.comparison, written.page
    cells = [element for element in page.named("td") if "data-value" in element.attributes]
    figures = comparison.runs[0].evaluation
    expected = [
        figures.auc_pr,
        figures.auc_roc,
        *(figures.recall_at[depth] for depth in ("1", "5", "10")),
        figures.recall_at_full_precision,
        figures.extended_precision,
        4.75,  # forward and match
        4.25,
        0.5,
        1536,
    ]
    first = cells[: len(expected)]
    assert [float(str(cell.attributes["data-value"])) for cell in first] == expected
    assert [cell.text for cell in first[:7]] == [f"{value:.3f}" for value in expected[:7]]
    assert [cell.text for cell in first[7:]] == ["4.8", "4.2", "0.50", "1.5\N{NO-BREAK SPACE}KB"]
    assert len(cells) == 2 * len(expected)


def test_page_refers_to_nothing_outside_itself(written: Written) -> None:
    html, page = written.html, written.page
    ids = {element.attributes.get("id") for element in page.elements}
    for element in page.elements:
        for name in ("src", "srcset", "href", "xlink:href", "action", "data", "poster"):
            address = element.attributes.get(name)
            if address is not None:
                assert address.startswith(("data:", "#")), address[:80]
                assert not address.startswith("#") or address[1:] in ids
    assert set(re.findall(r"url\(.", html)) == {"url(#"}
    assert set(re.findall(r"url\(#([^)]*)\)", html)) <= ids
    assert "@import" not in html
    assert not re.search(r"https?:|//\w", re.sub(r"data:[\w/;,+=-]*", "", html))


def test_every_image_has_a_text(written: Written) -> None:
    page = written.page
    images = page.named("img")
    assert images
    for image in images:
        assert "alt" in image.attributes
        # What lies over the matrix is described with it.
        assert image.attributes["alt"] or "layer" in str(image.attributes["class"])
    drawings = [svg for svg in page.named("svg") if svg.attributes.get("role") == "img"]
    assert drawings
    assert all(svg.attributes["aria-label"] for svg in drawings)
    assert all(figure.attributes["aria-label"] for figure in page.named("figure", "plot"))
    assert all("scope" in head.attributes for head in page.named("th"))


def test_the_verdicts_by_size_of_map_are_in_a_table(written: Written) -> None:
    assert "In maps of any size" in written.html
    cells = ("4", "4", "0.500", "0.750", "3", "0.062", "0.250", "0.188", "0.125")
    assert "".join(f"<td>{cell}</td>" for cell in cells) in written.html


def test_files_beside_the_page_are_pictures(written: Written) -> None:
    names = sorted(path.name for path in written.folder.iterdir())
    assert names == [
        "cost.png",
        "index.html",
        "pr.png",
        "recall.png",
        "roc.png",
        "scalability-auc-pr.png",
        "scalability-recall.png",
        "scalability-time.png",
        "scores-after-system-0.png",
        "scores-after-system-1.png",
        "scores-before-system-0.png",
        "scores-before-system-1.png",
        "severity-a-b-c-recall.png",
        "severity-a-b-c.png",
        "similarity-system-0.png",
        "similarity-system-1.png",
        "sizes-error.png",
        "sizes-known.png",
        "sizes-strangers.png",
        "verified-error.png",
        "verified-known.png",
        "verified-strangers.png",
    ]
    for name in names:
        if name.endswith(".png"):
            image = cv2.imread(str(written.folder / name))
            assert image is not None, name
            assert image.std() > 5, f"{name} is blank"


@pytest.mark.thorough
def test_hostile_names_are_text(tmp_path: Path) -> None:
    evil = '<script>alert("1")</script>&\N{RIGHT-TO-LEFT OVERRIDE}$\\frac{$'
    comparison = make_comparison(tmp_path, systems=1, retained=range(6))
    names = ["'><img src=x onerror=alert(2)>.png", os.fsdecode(b"not-\xff-unicode.png")]
    hostile = replace(
        comparison,
        name=evil,
        queries=write_images(tmp_path / "hostile", 8, names),
        notes=[evil],
        runs=[make_run(evil, comparison.runs[0].scores, comparison.retained, comparison.truth, title=evil)],
        severity=[SeverityCurve(evil, evil, [0.0, 1.0], evil, [0.9, 0.5], [0.8, 0.3])],
    )
    html, page = page_of(tmp_path / "report", hostile)
    assert len(page.named("script")) == 1
    assert not [element for element in page.elements if "onerror" in element.attributes]
    assert "alert(" not in page.named("script")[0].text
    assert page.named("h1")[0].text == evil.replace("\N{RIGHT-TO-LEFT OVERRIDE}", "\N{REPLACEMENT CHARACTER}")
    assert "not-\\udcff-unicode.png" in html
    assert all(re.fullmatch(r"[a-z0-9.-]+", path.name) for path in (tmp_path / "report").iterdir())


@pytest.mark.thorough
def test_wrong_matches_come_first(tmp_path: Path) -> None:
    scores = np.eye(4, dtype=np.float32)
    scores[1] = [0.9, 0.1, 0, 0]  # wrong, sure
    scores[2] = [0, 0.3, 0.2, 0]  # wrong, unsure
    retained, truth = np.arange(4), tolerance_truth(4, 4, 0)
    comparison = replace(
        make_comparison(tmp_path, systems=1, count=4),
        runs=[make_run("mixed", scores, retained, truth)],
        retained=retained,
    )
    _, page = page_of(tmp_path / "report", comparison)
    articles = page.named("article")
    assert [element.text.startswith(f"Query {query} ") for element, query in zip(articles, (1, 2, 0, 3), strict=True)]
    assert [article.attributes["class"] for article in articles] == ["case wrong"] * 2 + ["case right"] * 2
    assert "Best match 0 wrongscore 0.900" in articles[0].text
    assert "Truth 1 score 0.100, rank 2" in articles[0].text
    headings = [heading.text for heading in page.named("h4")]
    assert headings[0].startswith("Wrong matches all 2")
    assert headings[1].startswith("Right matches all 2")


@pytest.mark.thorough
def test_without_a_wrong_match_there_is_nothing_to_reject_and_without_negatives_no_roc(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1, noise=0)
    html, page = page_of(tmp_path / "report", comparison)
    assert comparison.runs[0].evaluation.right == 8
    assert "there is nothing to reject" in html
    assert "all right" in page.named("td", "bar")[0].text
    assert not (tmp_path / "report" / "scores-after-system-0.png").exists()
    assert "There is none." in html
    assert "There is no ROC curve: every query has a retained true reference" in html
    assert not (tmp_path / "report" / "roc.png").exists()


@pytest.mark.thorough
def test_without_a_right_match_there_is_no_curve(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1)
    backwards = make_run("backwards", -np.eye(8, dtype=np.float32), comparison.retained, comparison.truth)
    html, _ = page_of(tmp_path / "report", replace(comparison, runs=[backwards]))
    assert "no precision–recall curve, of backwards" in html
    assert not (tmp_path / "report" / "pr.png").exists()
    assert (tmp_path / "report" / "recall.png").exists()


@pytest.mark.thorough
def test_every_query_is_a_negative(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1)
    nothing = [np.array([], np.int64)] * 8
    run = make_run("lost", comparison.runs[0].scores, comparison.retained, nothing)
    html, page = page_of(tmp_path / "report", replace(comparison, truth=nothing, runs=[run]))
    assert "no query has a retained true reference" in html
    assert len(page.named("article")) == 8
    assert "True reference" in page.named("article")[0].text


@pytest.mark.thorough
def test_one_query_and_one_reference(tmp_path: Path) -> None:
    html, page = page_of(tmp_path / "report", make_comparison(tmp_path, systems=1, count=1))
    assert "1 query" in html
    assert len(page.named("article")) == 1


@pytest.mark.thorough
def test_more_systems_than_hues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Two plots of each system, which take most of the time and know of no other system.
    monkeypatch.setattr("lab.evaluation.report.closeup.plot_fates", lambda *_: [])
    comparison = make_comparison(tmp_path, systems=10, retained=range(6))
    _, page = page_of(tmp_path / "report", comparison)
    assert len(page.named("section", "run")) == 10 > len(LIGHT.hues)
    rows = [element for element in page.named("th") if element.attributes["scope"] == "row"]
    names = [row.text for row in rows if "data-value" in row.attributes]
    assert names == [run.about.name for run in comparison.runs]
    assert len(list((tmp_path / "report").glob("similarity-*.png"))) == 10


@pytest.mark.thorough
def test_regions_are_drawn_for_the_run_that_they_are_of(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, retained=range(6))
    second = comparison.runs[1]
    seen: list[Path] = []

    def regions(path: Path) -> list[tuple[float, float, float, float]]:
        seen.append(path)
        return [(0.25, 0.5, 0.75, 1.0)] * 3  # the same box from several maps is drawn once

    page = page_of(tmp_path / "report", replace(comparison, regions=regions, regions_of=second.identity))[1]
    rectangles = [rectangle for rectangle in page.named("rect") if rectangle.attributes["width"] == "24.0"]
    assert len(rectangles) == len(seen) > 0
    wanted = {"x": "12.0", "y": "18.0", "width": "24.0", "height": "18.0"}
    assert all(rectangle.attributes == wanted for rectangle in rectangles)
    sections = page.named("section", "run")
    assert ["regions of interest" in section.text for section in sections] == [False, True]


@pytest.mark.thorough
def test_images_that_are_gone_leave_their_names(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path, systems=1)
    comparison.queries[3].unlink()
    without = replace(comparison, references=[])
    _, page = page_of(tmp_path / "report", without)
    assert sum(article.text.count("no image") for article in page.named("article")) >= len(page.named("article")) * 2


@pytest.mark.thorough
def test_failure_while_it_is_made_writes_nothing(tmp_path: Path) -> None:
    def regions(path: Path) -> None:
        raise RuntimeError(path.name)

    with pytest.raises(RuntimeError):
        write_report(tmp_path / "report", replace(make_comparison(tmp_path), regions=regions))
    assert not (tmp_path / "report").exists()


@pytest.mark.thorough
def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageFailure, match=r"The report cannot be written to .*file"):
        write_report(tmp_path / "file", make_comparison(tmp_path, systems=1))


def test_no_run_no_report(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one run"):
        write_report(tmp_path / "report", replace(make_comparison(tmp_path), runs=[]))


# How it looks


def test_every_colour_that_is_used_is_defined_for_both_themes(written: Written) -> None:
    (style,) = written.page.named("style")
    used = set(re.findall(r"var\((--[\w-]+)\)", written.html)) - {"--size"}  # set on each bar
    light, dark = (set(re.findall(r"(--[\w-]+):", part)) for part in style.text.split("@media", 1)[:2])
    assert used <= light | dark
    assert style.text.index(LIGHT.paper) < style.text.index("prefers-color-scheme: dark") < style.text.index(DARK.paper)
    for name in variables(LIGHT):
        assert style.text.count(f"--{name}:") == 2, name


def test_style_and_script_are_whole(written: Written) -> None:
    folder = Path(page_module.__file__).parent
    (style,), (script,) = written.page.named("style"), written.page.named("script")
    assert (folder / "page.css").read_text("utf-8").strip() in style.text
    assert (folder / "page.js").read_text("utf-8").strip() == script.text.strip()


# Its files


def test_files_are_replaced_and_others_stay(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    write_files(tmp_path, {"pr.png": b"png", "index.html": b"new"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "index.html": b"new",
        "notes.txt": b"mine",
        "pr.png": b"png",
    }


@pytest.mark.parametrize(
    ("number", "error", "sentence"),
    [(errno.ENOSPC, StorageFull, "The disk is full"), (errno.EACCES, StorageFailure, "cannot be written")],
)
def test_failed_write_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, error: type[Exception], sentence: str
) -> None:
    (tmp_path / "index.html").write_text("old")
    write = Path.write_bytes

    def fail(path: Path, data: bytes) -> int:
        if data == b"new":
            write(path, data[:1])
            raise OSError(number, os.strerror(number))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(error, match=sentence):
        write_files(tmp_path, {"pr.png": b"png", "index.html": b"new"})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"index.html": "old"}


def test_failed_rename_leaves_no_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "index.html").mkdir()
    with pytest.raises(StorageFailure):
        write_files(tmp_path, {"pr.png": b"png", "index.html": b"new"})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["index.html", "pr.png"]


def test_what_was_not_measured_here_stands_apart(written: Written) -> None:
    """Published figures are in one table of their own, and similarities from elsewhere say that they are."""
    (row,) = [row.text for row in written.page.named("tr") if "Ghost" in row.text]
    assert row == "Ghost <net>0.5000.750–2024Some paper, Table 1"
    assert written.html.count("Ghost") == 1  # in no chart and no other table
    assert "Nothing in this table was measured here" in written.html
    (other,) = [run for run in written.comparison.runs if run.elsewhere]
    assert f"only judged here: {other.about.title}." in written.html
