"""CALC's network, of its real shapes, held to arithmetic by hand and to OpenCV's reader of Caffe networks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import InvalidModel
from lab.baselines.calc import ABOUT, Calc, grey_input, load_calc
from tests.lab.conversion.caffe_writer import Layer, caffemodel, field, layer, prototxt, relu

SHAPES = {"conv1": (64, 1, 5, 5), "conv2": (128, 64, 4, 4), "conv3": (4, 128, 3, 3)}
FRAME = np.random.default_rng(0).integers(0, 256, (90, 130, 3), np.uint8)


def written(weights: dict[str, NDArray[np.float32]], biases: dict[str, NDArray[np.float32]]) -> list[Layer]:
    """The layers as the authors' training writes them, the decoder's first one among them."""
    parts = {"conv1": {"kernel_size": 5, "stride": 2, "pad": 4}, "conv2": {"kernel_size": 4, "pad": 2}, "conv3": {}}
    parts["conv3"] = {"kernel_size": 3}
    layers: list[Layer] = []
    bottom = "X1"
    for number, (name, part) in enumerate(parts.items(), 1):
        sides = {"num_output": SHAPES[name][0], **part}
        layers.append(layer(name, "Convolution", bottom, blobs=(weights[name], biases[name]), convolution_param=sides))
        layers.append(layer(f"relu{number}", "ReLU", name))
        if number < 3:
            pool = {"pool": 0, "kernel_size": 3, "stride": 2}
            layers.append(layer(f"pool{number}", "Pooling", f"relu{number}", pooling_param=pool))
            lrn = {"local_size": 5, "alpha": 1e-4, "beta": 0.75}
            layers.append(layer(f"norm{number}", "LRN", f"pool{number}", lrn_param=lrn))
            bottom = f"norm{number}"
    return layers


def decoder() -> list[Layer]:
    ones = np.ones((2, 1064), np.float32)
    return [
        layer("fc4", "InnerProduct", "relu3", blobs=(ones,), inner_product_param={"num_output": 2}),
        relu("s", "fc4"),
    ]


def zeros(*, biases: bool = False) -> dict[str, NDArray[np.float32]]:
    return {name: np.zeros(shape[:1] if biases else shape, np.float32) for name, shape in SHAPES.items()}


def random_weights() -> tuple[dict[str, NDArray[np.float32]], dict[str, NDArray[np.float32]]]:
    random = np.random.default_rng(1)
    weights = {name: random.normal(0, 0.3, shape).astype(np.float32) for name, shape in SHAPES.items()}
    return weights, {name: random.normal(0, 0.1, shape[0]).astype(np.float32) for name, shape in SHAPES.items()}


def save(path: Path, layers: list[Layer], generation: str = "new", form: str = "new") -> Path:
    path.write_bytes(caffemodel(layers + decoder(), generation, form))
    return path


def shrunk(maps: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest of each 3 x 3, every second, with a last window that reaches over the edge; then normalized."""
    rows, columns = (-(-(side - 3) // 2) + 1 for side in maps.shape)
    pooled = np.array([[maps[2 * y : 2 * y + 3, 2 * x : 2 * x + 3].max() for x in range(columns)] for y in range(rows)])
    return np.asarray(pooled / (1 + 1e-4 / 5 * pooled**2) ** 0.75)


def test_one_channel_by_hand(tmp_path: Path) -> None:
    weights = zeros()
    weights["conv1"][0, 0, 2, 2] = 100  # of the second row and column on, every second
    weights["conv2"][0, 0, 1, 2] = 1
    weights["conv3"][:, 0, 1, 1] = [1, -1, 2, 0]
    biases = zeros(biases=True)
    biases["conv3"][:] = [0, 0, -50, 3]
    system = Calc(ABOUT, load_calc(save(tmp_path / "calc.caffemodel", written(weights, biases))))
    found = system.describe(FRAME)

    seen = np.pad(grey_input(FRAME).astype(np.float64), 4)
    first = shrunk(100 * seen[2::2, 2::2][:62, :82])  # 62 x 82 to 31 x 41
    second = shrunk(np.pad(first, 2)[1:, 2:][:32, :42])  # a 4 x 4 window sees the place one up of it; to 16 x 21
    middle = second[1:-1, 1:-1]
    wanted = np.maximum(np.stack([middle, -middle, 2 * middle - 50, np.full_like(middle, 3)]), 0).reshape(-1)
    assert found.arrays["descriptor"].shape == (1064,) == wanted.shape
    np.testing.assert_allclose(np.asarray(found.arrays["descriptor"]), wanted / np.linalg.norm(wanted), atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(("generation", "form"), [("new", "new"), ("old", "old")])
def test_it_is_what_opencv_makes_of_the_file(tmp_path: Path, generation: str, form: str) -> None:
    layers = written(*random_weights())
    path = save(tmp_path / "calc.caffemodel", layers, generation, form)
    network = load_calc(path)
    text = prototxt(layers, (1, 1, 120, 160)).replace(b'"data"', b'"X1"')
    net = cv2.dnn.readNetFromCaffe(np.frombuffer(text, np.uint8), np.frombuffer(caffemodel(layers), np.uint8))
    net.setInput(grey_input(FRAME)[None, None])
    wanted = net.forward("relu3").reshape(-1)
    found = np.asarray(Calc(ABOUT, network).describe(FRAME).arrays["descriptor"])
    np.testing.assert_allclose(found, wanted / np.linalg.norm(wanted), atol=1e-5)


def test_the_input_is_equalized_grey() -> None:
    ramp = np.repeat(np.linspace(100, 120, 160).astype(np.uint8)[None, :, None], 120, 0).repeat(3, 2)
    shown = grey_input(ramp)
    assert shown.shape == (120, 160) and shown.dtype == np.float32
    assert shown.min() == pytest.approx(0, abs=0.02) and shown.max() == pytest.approx(1, abs=0.02)


def test_a_blank_frame_has_a_description(tmp_path: Path) -> None:
    system = Calc(ABOUT, load_calc(save(tmp_path / "calc.caffemodel", written(zeros(), zeros(biases=True)))))
    blank = system.describe(np.zeros((20, 20, 3), np.uint8))
    assert not blank.arrays["descriptor"].any()
    assert system.index([blank, blank]).score([blank]).tolist() == [[0, 0]]


@pytest.mark.thorough
def test_networks_that_are_not_calc(tmp_path: Path) -> None:
    wide = {**zeros(), "conv1": np.zeros((64, 3, 5, 5), np.float32)}
    for layers, what in (
        (written(zeros(), zeros(biases=True))[:4], "conv2 has arrays of the shapes none"),
        (written(wide, zeros(biases=True)), r"conv1 has arrays of the shapes \[\(64, 3, 5, 5\)"),
    ):
        with pytest.raises(InvalidModel, match=what):
            load_calc(save(tmp_path / "a.caffemodel", layers))
    (tmp_path / "a.caffemodel").write_bytes(field(1, "nothing"))
    with pytest.raises(InvalidModel, match="conv1"):
        load_calc(tmp_path / "a.caffemodel")


def test_identities_tell_weights_apart(tmp_path: Path) -> None:
    weights, biases = random_weights()
    first = Calc(ABOUT, load_calc(save(tmp_path / "a.caffemodel", written(weights, biases)))).identity
    biases["conv2"][5] += 1
    second = Calc(ABOUT, load_calc(save(tmp_path / "b.caffemodel", written(weights, biases)))).identity
    assert first != second and first.startswith("calc@")
    assert ABOUT.weights is not None and "calc.caffemodel" in ABOUT.weights
