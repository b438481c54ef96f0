from __future__ import annotations

import errno
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from core.errors import StorageFailure, StorageFull
from lab.evaluation import SeverityCurve
from lab.evaluation.report import write_report
from lab.evaluation.report.page import write_files
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
