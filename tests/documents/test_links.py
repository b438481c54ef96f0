"""Links of the documents: each relative one leads to a file that is there, each anchor to a heading."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"\]\(([^)\s]+)\)|^\[[^\]]+\]: (\S+)$", re.MULTILINE)
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.DOTALL | re.MULTILINE)
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
ELSEWHERE = ("http://", "https://", "mailto:")


def documents() -> list[Path]:
    """Every Markdown file that git knows or would take."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    paths = [ROOT / name for name in listed.stdout.splitlines()] if listed.returncode == 0 else []
    return sorted(path for path in paths or ROOT.rglob("*.md") if path.is_file() and ".venv" not in path.parts)


@cache
def anchors(document: Path) -> set[str]:
    """The anchors of a document's headings, as GitHub makes them."""
    headings = HEADING.findall(re.sub(r"^```.*?^```$", "", document.read_text(), flags=re.DOTALL | re.MULTILINE))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def test_links_lead_somewhere() -> None:
    broken = [f"{one.relative_to(ROOT)}: {link}" for one in documents() for link in links(one) if not leads(one, link)]
    assert broken == []


def links(document: Path) -> Iterator[str]:
    """Those to files and headings of the project."""
    for inline, named in LINK.findall(CODE.sub("", document.read_text())):
        if not (link := inline or named).startswith(ELSEWHERE):
            yield link


def leads(document: Path, link: str) -> bool:
    """Whether a link leads to a file of the project and, if it has an anchor, to a heading in it."""
    path, _, anchor = link.partition("#")
    target = (document.parent / path).resolve() if path else document
    return target.exists() and target.is_relative_to(ROOT) and (not anchor or anchor in anchors(target))
