"""The registry: what is listed can be built, and missing weights are named."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidModel, MissingWeights, UnknownEncoder
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.presets import NETWORK
from lab.baselines.encoders import EncoderSystem
from lab.baselines.registry import BASELINES, build, systems
from lab.baselines.system import Trainable

THESIS = {
    "region-vlad",
    "m-region-vlad",
    "cross-region-vlad",
    "cross-region-bow",
    "cross-region-bow-2.6k",
    "rmac",
    "rmac-mutual",
    "spp",
    "sum-pool",
    "max-pool",
    "cross-pool",
    "whole",
    "hog",
    "seqslam",
    "fabmap",
    "netvlad",
    "alexnet",
    "amosnet",
    "hybridnet",
    "places365",
    "calc",
    "fix-context",
    "attentive-attention",
    "context-flexible-attention",
}
"""Every system that the thesis compares with."""

FREE = [baseline.about.name for baseline in BASELINES if baseline.about.weights is None]
WEIGHTED = [baseline.about.name for baseline in BASELINES if baseline.about.weights is not None]


@pytest.fixture(scope="module")
def models() -> EncoderCatalogue:
    return EncoderCatalogue()


def test_every_system_of_the_thesis_is_listed_once(models: EncoderCatalogue) -> None:
    names = [about.name for about in systems(models)]
    assert set(names) >= THESIS
    assert len(set(names)) == len(names)


def test_each_says_its_title_paper_and_constants(models: EncoderCatalogue) -> None:
    for about in systems(models):
        assert re.fullmatch(r"[a-z0-9][a-z0-9.-]*", about.name)
        assert about.title and about.configuration, about.name
        assert re.search(r"\b(19|20)\d\d\b", about.paper), about.name


@pytest.mark.thorough
@pytest.mark.parametrize("name", FREE)
def test_what_needs_no_weights_is_built(name: str, models: EncoderCatalogue) -> None:
    system = build(name, models=models)
    assert system.about.name == name
    assert re.fullmatch(rf"{re.escape(name)}@[0-9a-f]{{64}}", system.identity)
    assert build(name, models=models).identity == system.identity


@pytest.mark.thorough
@pytest.mark.parametrize("name", FREE)
def test_a_map_of_one_place_and_a_blank_query_have_scores(name: str, models: EncoderCatalogue) -> None:
    system = build(name, models=models)
    generator = np.random.default_rng(6)
    frames = [np.kron(generator.integers(0, 255, (9, 12, 3)), np.ones((12, 12, 1))).astype(np.uint8) for _ in range(4)]
    if isinstance(system, Trainable):
        system.train(frames, seed=0)
    blank = np.full((48, 64, 3), 5, np.uint8)
    queries = [system.describe(frames[0]), system.describe(blank)]
    for place in (frames[0], blank):
        scores = system.index([system.describe(place)]).score(queries)
        assert scores.shape == (2, 1) and scores.dtype == np.float32 and np.isfinite(scores).all()
    assert all(array.nbytes for query in queries for array in query.arrays.values())


def test_each_weights_sentence_ends_as_one() -> None:
    assert all(about.weights.endswith(".") for about in (one.about for one in BASELINES) if about.weights is not None)


@pytest.mark.parametrize("name", WEIGHTED)
def test_missing_weights_are_named_in_one_sentence(name: str, models: EncoderCatalogue, tmp_path: Path) -> None:
    with pytest.raises(MissingWeights, match=f"--weights {name}=FILE"):
        build(name, models=models)
    with pytest.raises(MissingWeights, match="there is no file"):
        build(name, models=models, weights=tmp_path / "absent")


def test_encoders_are_systems_by_name_and_by_identity(models: EncoderCatalogue) -> None:
    encoder = models.get(DEFAULT_ENCODER)
    for asked in (DEFAULT_ENCODER, encoder.identity):
        system = build(asked, models=models)
        assert isinstance(system, EncoderSystem)
        assert system.identity == encoder.identity and not system.sequential
    assert isinstance(build(f"{DEFAULT_ENCODER}.two-stages", models=models), EncoderSystem)
    with pytest.raises(InvalidModel, match="no file of weights"):
        build(DEFAULT_ENCODER, models=models, weights=Path(__file__))


def test_an_unknown_name_lists_what_there_is(models: EncoderCatalogue) -> None:
    with pytest.raises(UnknownEncoder, match=r"m-region-vlad.*seqslam"):
        build("orb-slam", models=models)


def test_another_network_may_be_given(models: EncoderCatalogue) -> None:
    network = models.network_file(NETWORK)
    assert build("spp", models=models, weights=network).identity == build("spp", models=models).identity
    with pytest.raises(InvalidModel, match="not a readable network file"):
        build("spp", models=models, weights=Path(__file__))


@pytest.mark.parametrize("name", ["hog", "seqslam", "fabmap"])
def test_what_uses_no_network_takes_no_weights(name: str, models: EncoderCatalogue) -> None:
    with pytest.raises(InvalidModel, match="takes no file"):
        build(name, models=models, weights=Path(__file__))


@pytest.mark.thorough
def test_listing_leaves_the_slow_libraries_alone() -> None:
    script = (
        "import sys; from core.method.catalogue import EncoderCatalogue; from lab.baselines.registry import systems; "
        "systems(EncoderCatalogue()); "
        "print(*{'sklearn', 'matplotlib', 'scipy.sparse', 'scipy.ndimage', 'scipy.io'} & set(sys.modules))"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=300)
    assert shown.stdout.split() == []
