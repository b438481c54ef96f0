"""The encoder as a whole: stages in order, identities, refusals, golden values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from core.backbone import PluggedNetwork
from core.encoder import Encoder, EncoderDefinition, FeatureExtractor, canary_frame
from core.encoders import EncoderCatalogue
from core.errors import GoldenMismatch, InvalidModel, WrongVocabulary
from core.network import ShallowNetwork, caffenet_definition
from core.preprocessing import InputDefinition
from core.regions import extract_regions, unit_length
from core.verdict import Calibration
from core.vlad import aggregate
from core.vocabulary import Vocabulary, pool_features, train_vocabulary

CALIBRATION = Calibration(source="test", threshold=1, margin=0, background_mean=0, background_deviation=1)
DEFINITION = EncoderDefinition(
    layers=("conv3", "conv4"),
    regions=50,
    steps=(0.05, 0.05),
    unit_features=True,
    words=8,
    gamma=0.5,
    normalization="intra",
)


def random_network(layers: tuple[str, ...] = ("conv3", "conv4"), seed: int = 0) -> ShallowNetwork:
    torch.manual_seed(seed)
    return ShallowNetwork(caffenet_definition("random", normalize=False, scale=0.017), layers).eval()


def random_frame(seed: int, height: int = 120, width: int = 160) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def vocabulary_for(extractor: FeatureExtractor, words: int = 8, seed: int = 0) -> Vocabulary:
    frames = [extractor.regions(extractor.activations([random_frame(n)])[0]).features for n in range(4)]
    return train_vocabulary(pool_features(frames, seed), words, seed, extractor.origin)


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    extractor = FeatureExtractor(random_network(), DEFINITION)
    return Encoder("small", extractor, DEFINITION, vocabulary_for(extractor), CALIBRATION)


def test_the_stages_follow_one_another(encoder: Encoder) -> None:
    frame = random_frame(9)
    encoding = encoder.encode(frame)
    conv3, conv4 = encoder.extractor.activations([frame])[0]
    regions = extract_regions([conv3, conv4], (0.05, 0.05), 50)
    wanted = aggregate(unit_length(regions.features), encoder.centers, 0.5, "intra")
    np.testing.assert_array_equal(encoding.descriptor, wanted)
    assert len(encoding.regions) == 100
    assert encoding.descriptor.shape == (8 * 384,)
    assert set(encoding.milliseconds) == {"forward", "regions", "vlad"}


def test_a_batch_gives_what_single_frames_give(encoder: Encoder) -> None:
    frames = [random_frame(1), random_frame(2, 300, 200), random_frame(3, 16, 900)]
    for frame, encoding in zip(frames, encoder.encode_batch(frames), strict=True):
        alone = encoder.encode(frame).descriptor
        assert float(alone @ encoding.descriptor) >= 0.999 * float(alone @ alone)
    assert encoder.encode_batch([]) == []


@pytest.mark.parametrize("shape", [(16, 16), (16, 4000), (3000, 2000)])
def test_tiny_and_huge_frames(encoder: Encoder, shape: tuple[int, int]) -> None:
    encoding = encoder.encode(random_frame(0, *shape))
    assert np.isfinite(encoding.descriptor).all()
    assert len(encoding.regions) > 0


def test_a_frame_without_regions_has_a_zero_descriptor() -> None:
    network = random_network()
    for tensor in network.state_dict().values():
        tensor.zero_()
    extractor = FeatureExtractor(network, DEFINITION)
    vocabulary = Vocabulary(np.ones((8, 384), np.float32), extractor.origin)
    encoding = Encoder("blank", extractor, DEFINITION, vocabulary, CALIBRATION).encode(random_frame(0))
    assert len(encoding.regions) == 0
    assert not encoding.descriptor.any()


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (20, 120, 200)])
def test_a_blank_frame_has_no_region_whatever_its_colour(colour: tuple[int, int, int]) -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    blank = np.full((240, 320, 3), colour, np.uint8)
    noise = np.random.default_rng(0).normal(0, 1, blank.shape).round()
    for frame in (blank, np.clip(blank + noise, 0, 255).astype(np.uint8)):
        encoding = encoder.encode(frame)
        assert len(encoding.regions) == 0
        assert not encoding.descriptor.any()


def test_a_dark_frame_is_not_a_blank_one() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    assert len(encoder.encode((random_frame(4) // 16).astype(np.uint8)).regions) > 0


def test_the_score_is_the_mean_cosine(encoder: Encoder) -> None:
    a, b = (encoder.encode(random_frame(n)).descriptor for n in (1, 2))
    assert encoder.score(a, b) == pytest.approx(float(a @ b) / 8)
    assert encoder.score(a, a) == pytest.approx(np.count_nonzero(a.reshape(8, -1).any(axis=1)) / 8, abs=1e-5)


@pytest.mark.parametrize(
    "change",
    [{"regions": 51}, {"steps": (0.05, 0.06)}, {"unit_features": False}, {"layers": ("conv4", "conv3")}],
)
def test_a_vocabulary_is_refused_for_other_features(encoder: Encoder, change: dict[str, object]) -> None:
    other = DEFINITION.model_copy(update=change)
    vocabulary = Vocabulary(encoder.centers, encoder.extractor.origin)
    with pytest.raises(WrongVocabulary, match="train it again"):
        Encoder("small", FeatureExtractor(random_network(other.layers), other), other, vocabulary, CALIBRATION)


def test_a_vocabulary_is_refused_for_other_weights(encoder: Encoder) -> None:
    vocabulary = Vocabulary(encoder.centers, encoder.extractor.origin)
    with pytest.raises(WrongVocabulary):
        Encoder("small", FeatureExtractor(random_network(seed=1), DEFINITION), DEFINITION, vocabulary, CALIBRATION)


def test_the_identity_covers_each_choice(encoder: Encoder) -> None:
    extractor = encoder.extractor
    vocabulary = Vocabulary(encoder.centers, extractor.origin)
    identities = {encoder.identity}
    for change in ({"gamma": 0.4}, {"normalization": "global"}):
        other = DEFINITION.model_copy(update=change)
        identities.add(Encoder("small", extractor, other, vocabulary, CALIBRATION).identity)
    moved = Vocabulary(encoder.centers + np.float32(1e-6), extractor.origin)
    identities.add(Encoder("small", extractor, DEFINITION, moved, CALIBRATION).identity)
    assert len(identities) == 4
    again = Encoder("small", extractor, DEFINITION, vocabulary, CALIBRATION)
    assert again.identity == encoder.identity
    assert encoder.identity.startswith("small@") and len(encoder.identity) == len("small@") + 64


def test_the_words_must_be_as_many_as_defined(encoder: Encoder) -> None:
    fewer = Vocabulary(encoder.centers[:7], encoder.extractor.origin)
    with pytest.raises(InvalidModel, match="8 words"):
        Encoder("small", encoder.extractor, DEFINITION, fewer, CALIBRATION)


def test_the_backbone_must_return_the_layers() -> None:
    with pytest.raises(InvalidModel, match="conv4"):
        FeatureExtractor(random_network(("conv3",)), DEFINITION)


def test_any_torch_network_can_be_plugged_in() -> None:
    torch.manual_seed(0)
    module = nn.Sequential(nn.Conv2d(3, 12, 5, 2), nn.ReLU(inplace=True), nn.Conv2d(12, 12, 3, 2), nn.Tanh())
    shown = InputDefinition(height=64, width=96, channel_order="rgb", mean=(120.0, 110.0, 100.0), scale=(0.02,) * 3)
    plugged = PluggedNetwork(module, ("0", "2"), shown, "two convolutions, version 1")
    definition = DEFINITION.model_copy(update={"layers": ("0", "2"), "words": 4})
    extractor = FeatureExtractor(plugged, definition)
    frame = random_frame(3, 64, 96)
    first, second = extractor.activations([frame])[0]
    images = torch.from_numpy((frame[:, :, ::-1].astype(np.float32) - [120, 110, 100]) * 0.02).permute(2, 0, 1).float()
    with torch.no_grad():
        wanted = torch.relu(module[0](images[None]))[0].permute(1, 2, 0).numpy()
        deeper = torch.relu(module[2](module[1](module[0](images[None]))))[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(first, wanted, atol=1e-5)
    np.testing.assert_allclose(second, deeper, atol=1e-5)
    frames = [extractor.regions(extractor.activations([random_frame(n)])[0]).features for n in range(3)]
    vocabulary = train_vocabulary(pool_features(frames, 0), 4, 0, extractor.origin)
    made = Encoder("plugged", extractor, definition, vocabulary, CALIBRATION).encode(frame)
    assert made.descriptor.shape == (48,) and made.descriptor.any()
    assert extractor.layer_grids() == {"0": (30, 46), "2": (14, 22)}


def test_a_plugged_network_names_real_layers() -> None:
    shown = InputDefinition(height=32, width=32, mean=(0.0, 0.0, 0.0))
    with pytest.raises(InvalidModel, match="fire9"):
        PluggedNetwork(nn.Sequential(nn.Conv2d(3, 4, 3)), ("fire9",), shown, "one convolution")


GOLDEN = {
    "m-region-vlad": (112, {7396: 0.1886, 40162: -0.0880, 16997: -0.0712, 34288: 0.0592, 40016: 0.0495}),
    "region-vlad": (45, {71908: 0.1877, 21833: 0.0783, 52589: 0.0601, 41601: -0.0468, 34912: 0.0367}),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_packaged_encoders_reproduce_their_golden_values(name: str) -> None:
    encoder = EncoderCatalogue().get(name)
    encoder.check_golden()
    encoding = encoder.encode(canary_frame())
    regions, values = GOLDEN[name]
    assert len(encoding.regions) == pytest.approx(regions, abs=2)  # one may cross a level on another processor
    for index, value in values.items():
        assert encoding.descriptor[index] == pytest.approx(value, abs=0.01)


def test_a_changed_encoder_fails_its_golden_values() -> None:
    packaged = EncoderCatalogue().get("m-region-vlad")
    vocabulary = Vocabulary(packaged.centers[::-1].copy(), packaged.extractor.origin)
    golden = packaged.encode(canary_frame()).descriptor
    changed = Encoder("m-region-vlad", packaged.extractor, packaged.definition, vocabulary, CALIBRATION, golden)
    with pytest.raises(GoldenMismatch, match="cosine"):
        changed.check_golden()
