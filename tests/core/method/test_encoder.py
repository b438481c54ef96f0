"""The encoder as a whole: stages in order, identities, refusals, golden values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from core.errors import GoldenMismatch, InvalidModel, WrongVocabulary
from core.frames.masks import Mask
from core.frames.preprocessing import InputDefinition
from core.judgement.verdict import Calibration
from core.method.agreement import AgreementDefinition, Cells, agreement
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import GOLDEN_COSINE, Encoder, EncoderDefinition, canary_frame
from core.method.equations import unit_length
from core.method.features import FeatureExtractor
from core.method.projection import Projection
from core.method.regions import extract_regions
from core.method.vlad import aggregate
from core.method.vocabulary import Vocabulary, pool_features, train_vocabulary
from core.networks.network import ShallowNetwork, caffenet_definition
from core.networks.torch_network import PluggedNetwork, TorchNetwork

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
    return TorchNetwork(caffenet_definition("random", normalize=False, scale=0.017), layers).as_data()


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
    np.testing.assert_allclose(encoding.descriptor, wanted, atol=1e-5)
    assert len(encoding.regions) == 100
    assert encoding.descriptor.shape == (8 * 384,)
    assert set(encoding.milliseconds) == {"forward", "regions", "vlad"}


def test_a_batch_gives_what_single_frames_give(encoder: Encoder) -> None:
    frames = [random_frame(1), random_frame(2, 300, 200), random_frame(3, 16, 900)]
    for frame, encoding in zip(frames, encoder.encode_batch(frames), strict=True):
        alone = encoder.encode(frame).descriptor
        assert float(alone @ encoding.descriptor) >= 0.999 * float(alone @ alone)
    assert encoder.encode_batch([]) == []


LOWER_LEFT = Mask(polygons=(((0.0, 0.5), (0.5, 0.5), (0.5, 1.0), (0.0, 1.0)),))


def test_what_a_mask_covers_does_not_count() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    frame = canary_frame()
    other = frame.copy()
    other[250:, :310] = random_frame(7, 230, 310)  # well within the mask
    masked, same = encoder.encode_batch([frame, other], [LOWER_LEFT, LOWER_LEFT])
    np.testing.assert_allclose(masked.descriptor, same.descriptor, atol=1e-4)
    np.testing.assert_allclose(masked.local.astype(int), same.local.astype(int), atol=1)  # steps of the quantisation
    seen, changed = (encoder.encode(one).descriptor for one in (frame, other))
    assert float(seen @ changed) < 0.99 * np.linalg.norm(seen) * np.linalg.norm(changed)


def test_covered_cells_bear_no_region_and_no_local_descriptor() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    masked, free = encoder.encode_batch([canary_frame(), canary_frame()], [LOWER_LEFT, None])
    hidden = LOWER_LEFT.covered(13, 13)
    assert not masked.local.reshape(13, 13, -1)[hidden].any()
    assert free.local.reshape(13, 13, -1)[hidden].any(axis=1).all()
    for top, left, bottom, right in masked.regions.boxes:
        assert not hidden[top:bottom, left:right].all()
    alone = encoder.encode(canary_frame())
    assert float(free.descriptor @ alone.descriptor) >= 0.999 * float(alone.descriptor @ alone.descriptor)


def test_a_frame_that_shows_nothing_outside_its_mask_is_blank() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    frame = np.full((240, 320, 3), 90, np.uint8)
    frame[130:, :150] = random_frame(1, 110, 150)
    assert len(encoder.encode(frame).regions) > 0
    assert len(encoder.encode(frame, LOWER_LEFT).regions) == 0


def test_there_is_one_mask_a_frame() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    with pytest.raises(ValueError):
        encoder.encode_batch([canary_frame(), canary_frame()], [LOWER_LEFT])


@pytest.mark.parametrize("shape", [(16, 16), (16, 4000), (3000, 2000)])
def test_tiny_and_huge_frames(encoder: Encoder, shape: tuple[int, int]) -> None:
    encoding = encoder.encode(random_frame(0, *shape))
    assert np.isfinite(encoding.descriptor).all()
    assert len(encoding.regions) > 0


def test_a_frame_without_regions_has_a_zero_descriptor() -> None:
    network = random_network()
    for array in network.weights().values():
        array[:] = 0
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
    first, second = (encoder.encode(random_frame(n)) for n in (1, 2))
    a, b = first.descriptor, second.descriptor
    assert encoder.score(first, second) == pytest.approx(float(a @ b) / 8)
    words_used = np.count_nonzero(a.reshape(8, -1).any(axis=1))
    assert encoder.score(first, first) == pytest.approx(words_used / 8, abs=1e-5)


def test_with_a_second_stage_the_score_is_shared_with_the_agreement() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    stage = encoder.definition.agreement
    assert stage is not None
    assert encoder.local_shape == (13 * 13, stage.length)
    a, b = (encoder.encode(random_frame(n)) for n in (1, 2))
    first = (1 - stage.share) * float(a.descriptor @ b.descriptor) / encoder.definition.words
    second = float(encoder.agreement(a.local, b.local[np.newaxis])[0])
    assert encoder.score(a, b) == pytest.approx(first + second, abs=1e-5)
    assert encoder.score(a, b) < 0.5 < encoder.score(a, a) <= 1 + 1e-3


def test_a_frame_without_regions_scores_zero_in_the_second_stage_too() -> None:
    packaged = EncoderCatalogue().get("m-region-vlad")
    definition = packaged.definition.model_copy(update={"steps": (1e6, 1e6)})  # levels that nothing reaches
    projections, cells = packaged.extractor.projections, packaged.extractor.cells
    extractor = FeatureExtractor(packaged.extractor.backbone, definition, projections, cells)
    vocabulary = Vocabulary(packaged.centers, extractor.origin)
    encoding = Encoder("blind", extractor, definition, vocabulary, CALIBRATION).encode(random_frame(1))
    assert len(encoding.regions) == 0
    assert encoding.local.shape == packaged.local_shape and not encoding.local.any()
    assert packaged.score(encoding, encoding) == 0
    assert packaged.score(packaged.encode(random_frame(1)), encoding) == 0


def test_regional_features_are_projected_whatever_the_layers_grids() -> None:
    torch.manual_seed(0)
    module = nn.Sequential(nn.Conv2d(3, 12, 5, 2), nn.ReLU(), nn.Conv2d(12, 12, 3, 2))
    shown = InputDefinition(height=64, width=96, mean=(120.0, 110.0, 100.0), scale=(0.02,) * 3)
    definition = DEFINITION.model_copy(update={"layers": ("2", "0"), "projection": 5})
    generator = np.random.default_rng(0)
    projections = {
        layer: Projection(
            (generator.random(12) / 12).astype(np.float32), generator.standard_normal((12, 7)).astype(np.float32)
        )
        for layer in ("0", "2")
    }
    extractor = FeatureExtractor(PluggedNetwork(module, ("2", "0"), shown, "two"), definition, projections)
    maps = extractor.activations([random_frame(3)])[0]
    assert [layer.shape[:2] for layer in maps] == [(14, 22), (30, 46)]
    made, summed = extractor.regions(maps), extract_regions(maps, definition.steps, definition.regions)
    assert set(made.layers.tolist()) == {0, 1}
    for index, name in enumerate(("2", "0")):
        of_layer = made.layers == index
        wanted = projections[name](summed.features[of_layer], 5)
        np.testing.assert_allclose(made.features[of_layer], wanted, atol=1e-4)


def test_layers_of_different_grids_cannot_be_compared_cell_by_cell(encoder: Encoder) -> None:
    stage = AgreementDefinition(
        layers=("pool1", "conv3"), values=2, weights=(0.5, 0.5), reach=(1, 1), candidates=3, share=0.5
    )
    definition = DEFINITION.model_copy(update={"agreement": stage})
    channels = {"pool1": 96, "conv3": 384}
    projections = {
        layer: Projection(np.zeros(count, np.float32), np.eye(count, 2, dtype=np.float32))
        for layer, count in channels.items()
    }
    extractor = FeatureExtractor(random_network(definition.outputs), definition, projections)
    vocabulary = Vocabulary(encoder.centers, extractor.origin)
    with pytest.raises(InvalidModel, match="different grids"):
        Encoder("uneven", extractor, definition, vocabulary, CALIBRATION)


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
    "m-region-vlad": (246, {15234: -0.2090, 3919: -0.0519, 7338: -0.0412, 14742: 0.0545, 10414: 0.0921}),
    "m-region-vlad-thesis": (600, {12288: 0.1126, 12551: -0.1175, 3714: 0.1294, 45644: 0.1272, 31433: 0.1055}),
    "region-vlad": (400, {82737: 0.1115, 12487: 0.1151, 55381: 0.1251, 72544: 0.1234, 46413: -0.1041}),
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


def test_a_changed_second_stage_changes_the_identity_and_keeps_the_descriptors() -> None:
    packaged = EncoderCatalogue().get("m-region-vlad")
    plain = AgreementDefinition(
        layers=("pool2", "conv3", "conv4"), values=64, weights=(0.4, 0.4, 0.2), reach=(2, 5), candidates=30, share=0.75
    )
    projections = packaged.extractor.projections

    def with_stage(stage: AgreementDefinition, cells: dict[str, Projection] | None = None) -> Encoder:
        definition = packaged.definition.model_copy(update={"agreement": stage})
        extractor = FeatureExtractor(packaged.extractor.backbone, definition, projections, cells)
        vocabulary = Vocabulary(packaged.centers, extractor.origin)
        return Encoder("m-region-vlad", extractor, definition, vocabulary, CALIBRATION)

    old = with_stage(plain)
    assert old.identity == "m-region-vlad@9584cde69ac83864efd2ddb560b29b7cf88ea4e9e0c148d190beb8e55a8cde9e"
    assert old.screened == old.candidates == 30
    frame, seen = old.encode(canary_frame()), {old.identity}
    taught = plain.model_copy(update={"taught": True})
    for other, same_cells in (
        (with_stage(plain.model_copy(update={"centred": 0.75})), False),
        (with_stage(plain.model_copy(update={"screened": 60})), True),
        (with_stage(taught, {layer: projections[layer] for layer in plain.layers}), True),
        (packaged, False),
    ):
        assert other.identity not in seen
        seen.add(other.identity)
        made = other.encode(canary_frame())
        np.testing.assert_array_equal(made.descriptor, frame.descriptor)
        assert made.local.shape == frame.local.shape
        assert np.array_equal(made.local, frame.local) == same_cells
    for stage, cells in (taught, {}), (taught, {"conv3": projections["conv3"]}), (plain, projections):
        with pytest.raises(InvalidModel, match="needs projections of its cells in"):
            with_stage(stage, cells)


def test_the_golden_check_leaves_nothing_to_compile_for_the_first_query(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[tuple[int, ...]] = []

    def watched(query: Cells, candidates: Cells, columns: int, definition: AgreementDefinition) -> NDArray[np.float32]:
        compared.append(candidates.shape)
        return agreement(query, candidates, columns, definition)

    monkeypatch.setattr("core.method.encoder.agreement", watched)
    encoder = EncoderCatalogue().get("m-region-vlad")
    encoder.check_golden()
    assert compared == [(1, *encoder.local_shape)]


def test_a_changed_encoder_fails_its_golden_values() -> None:
    packaged = EncoderCatalogue().get("m-region-vlad")
    vocabulary = Vocabulary(packaged.centers[::-1].copy(), packaged.extractor.origin)
    canary = packaged.encode(canary_frame())
    golden = (canary.descriptor, canary.local)
    changed = Encoder("m-region-vlad", packaged.extractor, packaged.definition, vocabulary, CALIBRATION, golden)
    with pytest.raises(GoldenMismatch, match="cosine"):
        changed.check_golden()


def test_a_lower_precision_keeps_no_promise_of_an_identity() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    frames = [canary_frame(), canary_frame()[:, ::-1].copy(), 255 - canary_frame()]
    exact = np.stack([encoder.encode(frame).descriptor for frame in frames])
    encoder.extractor.compute("bfloat16")
    made = np.stack([encoder.encode(frame).descriptor for frame in frames])
    assert (unit_length(exact) * unit_length(made)).sum(1).min() < GOLDEN_COSINE


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("name", ["m-region-vlad", "region-vlad"])
def test_a_gpu_makes_the_descriptors_of_the_processor(name: str) -> None:
    here, there = EncoderCatalogue().get(name), EncoderCatalogue(device="cuda").get(name)
    there.check_golden()
    frames = [canary_frame(), canary_frame()[:, ::-1].copy(), *(random_frame(n) for n in range(22))]
    for one, other in zip(here.encode_batch(frames), there.encode_batch(frames), strict=True):
        assert one.descriptor @ other.descriptor > GOLDEN_COSINE * np.square(one.descriptor).sum()


def test_a_plugged_network_takes_itself_elsewhere() -> None:
    module = nn.Conv2d(3, 4, 3)
    shown = InputDefinition(height=32, width=32, mean=(0.0, 0.0, 0.0))
    definition = DEFINITION.model_copy(update={"layers": ("0",), "steps": (0.05,)})
    extractor = FeatureExtractor(PluggedNetwork(nn.Sequential(module), ("0",), shown, "one"), definition)
    extractor.compute("float32", "cpu")
    with pytest.raises(InvalidModel, match="plugged"):
        extractor.compute("bfloat16")


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_a_batch_of_any_size_gives_each_frame_its_own_encoding(encoder: Encoder, count: int) -> None:
    frames = [random_frame(n) for n in range(count)]
    for frame, encoding in zip(frames, encoder.encode_batch(frames), strict=True):
        np.testing.assert_allclose(encoding.descriptor, encoder.encode(frame).descriptor, atol=1e-4)
