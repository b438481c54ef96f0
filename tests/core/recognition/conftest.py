"""The little encoder of two stages by which recognition is tested."""

from __future__ import annotations

import pytest

from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder
from tests.service.encoders import TWO_STAGES, install_two_stage_encoder


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Encoder:
    folder = tmp_path_factory.mktemp("models")
    install_two_stage_encoder(folder)
    return EncoderCatalogue(folder).get(TWO_STAGES)
