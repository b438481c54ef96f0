"""The region benchmark runs on every packaged encoder, those whose second stage compares further layers included."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import report
from benchmarks.thesis.regions import main
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue


@pytest.mark.parametrize(
    "encoder",
    [
        pytest.param(summary.name, marks=() if summary.name == DEFAULT_ENCODER else pytest.mark.thorough)
        for summary in EncoderCatalogue().describe()
    ],
)
def test_both_passes_are_measured(encoder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    main(encoder=encoder, step=None, rounds=3)
    figures = json.loads((tmp_path / "regions.json").read_text())
    assert figures["ratio"] == pytest.approx(figures["milliseconds"]["reference"] / figures["milliseconds"]["ours"])
    assert figures["ratio"] > 1
