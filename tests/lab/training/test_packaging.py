"""Packaging some of the encoders anew."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

from core.method.presets import NETWORK
from lab.training.packaging import main


def test_an_unknown_preset_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(typer.BadParameter, match=r"named netvlad; there are m-region-vlad,"):
        main(output=tmp_path / "models", only=["region-vlad", "netvlad"])
    assert not (tmp_path / "models").exists()


def test_the_network_is_that_of_the_output_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=NETWORK):
        main(output=tmp_path, only=["region-vlad"])
    assert list(tmp_path.iterdir()) == []
