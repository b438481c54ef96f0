from __future__ import annotations

import re

from core.evaluation.report.style import script, stylesheet
from core.evaluation.report.theme import DARK, LIGHT


def test_every_colour_that_is_used_is_defined_for_both_themes() -> None:
    rules = stylesheet()
    used = set(re.findall(r"var\((--[\w-]+)\)", rules)) - {"--size"}  # set on each bar
    light, dark = (set(re.findall(r"(--[\w-]+):", part)) for part in rules.split("@media", 1)[:2])
    assert used <= light | dark
    assert rules.count(LIGHT.paper) >= 1
    assert rules.index("prefers-color-scheme: dark") < rules.index(DARK.paper)
    for name in ("paper", "ink", "muted", "rule", "tp", "fp", "tn", "fn", "tint", *(f"hue-{i}" for i in range(8))):
        assert rules.count(f"--{name}:") == 2, name


def test_neither_can_end_its_element() -> None:
    assert "</" not in stylesheet()
    assert "</" not in script()
    assert script().startswith('"use strict"')
