"""Interleaved runs, and what they run."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch

from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.torch_network import PluggedNetwork
from service.commands.timing.samples import jpeg, sample_frame
from service.commands.timing.stages import (
    LAYOUTS,
    OWN,
    better_forward,
    encoding_runs,
    forward_passes,
    medians,
    search_run,
)


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get("region-vlad")


def test_runs_take_turns_and_the_warm_up_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    now = 0.0

    def takes(name: str, seconds: float) -> None:
        nonlocal now
        order.append(name)
        now += 10 * seconds if len(order) <= 2 else seconds

    monkeypatch.setattr(time, "perf_counter", lambda: now)
    times = medians({"a": lambda: takes("a", 2), "b": lambda: takes("b", 1)}, rounds=1, warm_up=1)
    monkeypatch.undo()
    assert order == ["a", "b"] * 2
    assert times == pytest.approx({"a": 2000, "b": 1000})


def test_the_bare_passes_compute_what_the_encoder_computes(encoder: Encoder) -> None:
    pixels = sample_frame(3)
    passes = forward_passes(encoder, pixels)
    assert set(passes) == set(LAYOUTS)
    wanted = encoder.extractor.activations([pixels])[0]
    for run in passes.values():
        found = run()
        assert isinstance(found, tuple)
        for ours, layer in zip(found, wanted, strict=True):
            np.testing.assert_allclose(ours[0].permute(1, 2, 0).numpy(), layer, atol=1e-3)


def test_the_runs_leave_the_encoder_as_it_was(encoder: Encoder) -> None:
    weights = encoder.extractor.backbone.weights()
    before = {name: array.copy() for name, array in weights.items()}
    for run in encoding_runs(encoder, jpeg(sample_frame())).values():
        run()
    assert before and all(np.array_equal(array, weights[name]) for name, array in before.items())


def test_another_kind_of_backbone_has_one_pass(encoder: Encoder, monkeypatch: pytest.MonkeyPatch) -> None:
    layer = torch.nn.Conv2d(3, 4, 3)
    plugged = PluggedNetwork(torch.nn.Sequential(layer), ["0"], encoder.extractor.backbone.input, "a test's")
    monkeypatch.setattr(encoder.extractor, "backbone", plugged)
    passes = forward_passes(encoder, sample_frame())
    assert list(passes) == [OWN] and better_forward({OWN: 2.0, "encode": 1.0}) == 2.0
    assert passes[OWN]() is not None


def test_a_search_is_a_whole_query_of_a_map(encoder: Encoder) -> None:
    with search_run(encoder, places=4) as search:
        found = search()
    assert isinstance(found, list)
    (located,) = found
    assert len(located.matches) == 4 and located.matches[0][1].id == "p00000"
