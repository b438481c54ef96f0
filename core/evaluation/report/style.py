"""How the page looks and what its one script does; both become part of it."""

from __future__ import annotations

from pathlib import Path

from core.evaluation.report.matrix import RIGHT, TRUTH, WRONG
from core.evaluation.report.theme import DARK, LIGHT, Theme


def stylesheet() -> str:
    """The rules of the page, its colours taken from the themes of the plots."""
    dark = f"@media (prefers-color-scheme: dark) {{ :root {{ {_variables(DARK)} }} }}"
    keys = f":root {{ --truth: {TRUTH}; --match-right: {RIGHT}; --match-wrong: {WRONG}; }}"
    hues = "".join(f".hue-{index} {{ stroke: var(--hue-{index}); }}" for index in range(len(LIGHT.hues)))
    return f":root {{ color-scheme: light dark; {_variables(LIGHT)} }}{dark}{keys}{hues}{_read('page.css')}"


def script() -> str:
    """What sorts the table, and shows one system at a time; without it all are shown."""
    return _read("page.js")


def _read(name: str) -> str:
    return (Path(__file__).parent / name).read_text("utf-8")


def _variables(theme: Theme) -> str:
    names = ("paper", "ink", "muted", "rule", "tp", "fp", "tn", "fn")
    tint = f"--tint: color-mix(in srgb, {theme.hues[0]} 16%, transparent);"
    hues = (f"--hue-{index}: {color};" for index, color in enumerate(theme.hues))
    return " ".join([*(f"--{name}: {getattr(theme, name)};" for name in names), tint, *hues])
