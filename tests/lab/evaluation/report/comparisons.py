"""Small comparisons whose scores are set by hand, and what a page says once it is read again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.traverses import Truth, tolerance_truth
from lab.baselines.system import About
from lab.evaluation import Outcome, SystemComparison, SystemRun, judge, summarize
from lab.evaluation.report import write_report

TIMES: dict[str, float | None] = {"forward": 4.25, "regions": None, "vlad": None, "match": 0.5}


def write_images(folder: Path, count: int, names: Sequence[str] = ()) -> list[Path]:
    """PNG files of 48 x 36 pixels, each of another colour."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / (names[index] if index < len(names) else f"{index:03}.png") for index in range(count)]
    for index, path in enumerate(paths):
        image = np.full((36, 48, 3), (40 * index % 256, 90, 200 - 10 * index % 200), np.uint8)
        image[:18, :24] = 255
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return paths


def make_run(
    name: str,
    scores: NDArray[np.float32],
    retained: NDArray[np.int64],
    truth: Truth,
    title: str | None = None,
    nbytes: int = 1536,
) -> SystemRun:
    """A run judged as any is."""
    outcomes = judge(scores, retained, truth)
    about = About(name, title or name, "Somebody, 2020", {"N": 300, "layers": ("conv3", "conv4")})
    identity = f"{name}@0123456789abcdef"
    return SystemRun(
        about, identity, summarize(identity, outcomes, len(retained), TIMES), outcomes, scores, nbytes, TIMES
    )


def make_comparison(
    folder: Path, systems: int = 2, retained: Sequence[int] | None = None, count: int = 8, noise: float = 1.0
) -> SystemComparison:
    """``count`` queries and references, the same place at the same index; each system is noisier than the last."""
    generator = np.random.default_rng(7)
    chosen = np.array(range(count) if retained is None else retained, np.int64)
    truth = tolerance_truth(count, count, 0)
    runs = []
    for place in range(systems):
        alike = np.eye(count, dtype=np.float32)[:, chosen]
        scores = (alike + noise * (0.3 + 0.1 * place) * generator.random(alike.shape)).astype(np.float32)
        runs.append(make_run(f"system-{place}", scores, chosen, truth))
    runs.sort(key=lambda run: -run.evaluation.auc_pr)
    return SystemComparison(
        "a data set",
        write_images(folder / "references", count),
        write_images(folder / "queries", count),
        chosen,
        truth,
        runs,
    )


def outcome(score: float, *, matched: bool = False, negative: bool = False) -> Outcome:
    """What became of a query; a wrong match of a query with a true reference has rank 2."""
    return Outcome(0, score, matched, None if negative else 1 if matched else 2)


@dataclass
class Element:
    """An element of a page: its tag, its attributes, and the text inside it and its children."""

    tag: str
    attributes: dict[str, str | None]
    text: str = ""


@dataclass
class Page(HTMLParser):
    """All elements of a page, in the order in which they open."""

    elements: list[Element] = field(default_factory=list)

    VOID = frozenset({"img", "meta", "link", "input", "br"})

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self._open: list[Element] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = Element(tag, dict(attrs))
        self.elements.append(element)
        if tag not in self.VOID:
            self._open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(Element(tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open[-1].tag == tag, f"</{tag}> closes <{self._open[-1].tag}>"
        self._open.pop()

    def handle_data(self, data: str) -> None:
        for element in self._open:
            element.text += data

    def named(self, tag: str, style: str | None = None) -> list[Element]:
        """The elements of a tag, or those of them that have a class."""
        found = [element for element in self.elements if element.tag == tag]
        return [one for one in found if style is None or style in (one.attributes.get("class") or "").split()]


def written_page(folder: Path, comparison: SystemComparison) -> Page:
    """The page of a comparison, written to a folder and read again."""
    return page_of(folder, comparison)[1]


def page_of(folder: Path, comparison: SystemComparison) -> tuple[str, Page]:
    """The same, and its text."""
    write_report(folder, comparison)
    html = (folder / "index.html").read_text("utf-8")
    return html, read_page(html)


@dataclass(frozen=True)
class Written:
    """A report with all its sections."""

    comparison: SystemComparison
    folder: Path
    html: str
    page: Page


def read_page(html: str) -> Page:
    """Parse a page, or a part of one; every element must be closed."""
    page = Page()
    page.feed(html)
    page.close()
    assert not page._open
    return page
