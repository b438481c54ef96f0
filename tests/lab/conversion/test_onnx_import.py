"""Networks in the ONNX format: what is imported computes what it says, and what is damaged or hostile is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, helper, numpy_helper

from core.errors import InvalidModel
from core.networks.description import Aggregation, NetworkDescription, Output, checked, read_description
from core.networks.files import network_name, open_network
from core.networks.onnx_network import OnnxNetwork, load_onnx_network, save_onnx_network
from core.networks.torch_network import as_array
from lab.conversion import onnx_import
from lab.conversion.onnx_import import import_onnx
from tests.lab.conversion.in_process import use
from tests.lab.conversion.onnx_writer import (
    CONVOLUTION,
    DESCRIPTOR,
    MAPS,
    SHOWN,
    SIDE,
    node,
    onnx_network,
    weights,
)


def write(folder: Path, model: ModelProto) -> Path:
    path = folder / "network.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def test_an_imported_network_computes_as_torch_does(tmp_path: Path) -> None:
    path = write(tmp_path, onnx_network(shape=("frames", 3, "height", "width")))
    network = OnnxNetwork("small", import_onnx(path, MAPS), MAPS)
    images = torch.randn(3, 3, SIDE, SIDE)
    (found,) = network(as_array(images))
    wanted = torch.nn.functional.conv2d(images, torch.from_numpy(weights()), stride=8)
    assert np.abs(found - as_array(wanted)).max() < 1e-4

    save_onnx_network(tmp_path / "small.network.safetensors", "small", network._graph, MAPS)
    again = load_onnx_network(tmp_path / "small.network.safetensors")
    assert np.array_equal(again(as_array(images))[0], found) and again.describe() == network.describe()
    assert network_name(tmp_path / "small.network.safetensors") == "small"
    with pytest.raises(InvalidModel, match="has no layers but output"):
        open_network(tmp_path / "small.network.safetensors", ("conv3",))


@pytest.mark.thorough
def test_tokens_are_the_cells_of_a_map_row_by_row(tmp_path: Path) -> None:
    tokens = [
        CONVOLUTION,
        node("Reshape", ["maps", "flat"], "cells"),
        node("Transpose", ["cells"], "patches", perm=[0, 2, 1]),
        node("Concat", ["first", "patches"], "tokens", axis=1),
    ]
    extra = [numpy_helper.from_array(np.array([1, 6, 16]), "flat")]
    extra.append(numpy_helper.from_array(np.full((1, 2, 6), 7, np.float32), "first"))
    path = write(tmp_path, onnx_network(tokens, "tokens", tensors=extra))
    description = checked(MAPS.model_dump() | {"output": {"kind": "tokens", "patch": 8, "skip": 2, "rectify": True}})
    network = OnnxNetwork("tokens", import_onnx(path, description), description)
    images = torch.randn(1, 3, SIDE, SIDE)
    wanted = torch.nn.functional.conv2d(images, torch.from_numpy(weights()), stride=8).relu()
    assert np.abs(network(as_array(images))[0] - as_array(wanted)).max() < 1e-4
    wrong = checked(description.model_dump() | {"output": {"kind": "tokens", "patch": 8, "skip": 1}})
    with pytest.raises(InvalidModel, match="not 17 tokens"):
        import_onnx(path, wrong)


def external(model: ModelProto, location: str, length: int | None = None) -> ModelProto:
    """The network with its weights in another file."""
    (tensor,) = (tensor for tensor in model.graph.initializer if tensor.name == "w")
    data = tensor.raw_data
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", str(length or len(data)))):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    return model


def test_weights_beside_the_file_are_taken_in_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, onnx_import.__name__)
    inside, outside = tmp_path / "model", tmp_path / "secret"
    inside.mkdir()
    outside.write_bytes(weights().tobytes())
    (inside / "network.onnx.data").write_bytes(weights().tobytes())
    alone = import_onnx(write(tmp_path, onnx_network()), MAPS)
    assert import_onnx(write(inside, external(onnx_network(), "network.onnx.data")), MAPS) == alone
    (inside / "link").symlink_to(outside)
    for location in ("../secret", str(outside), "link", "none", "", "."):
        with pytest.raises(InvalidModel, match="which is no file beside it"):
            import_onnx(write(inside, external(onnx_network(), location)), MAPS)
    (inside / "short").write_bytes(b"123")
    with pytest.raises(InvalidModel, match="the file is cut off"):
        import_onnx(write(inside, external(onnx_network(), "short")), MAPS)
    with pytest.raises(InvalidModel, match="the file is cut off"):
        import_onnx(write(inside, external(onnx_network(), "network.onnx.data", length=12)), MAPS)


LOOP = helper.make_node(
    "Loop",
    ["count", "", "images"],
    ["maps"],
    body=helper.make_graph(
        [
            node("Identity", ["condition"], "again"),
            node("Identity", ["value"], "after"),
        ],
        "body",
        [
            helper.make_tensor_value_info("number", TensorProto.INT64, []),
            helper.make_tensor_value_info("condition", TensorProto.BOOL, []),
            helper.make_tensor_value_info("value", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("again", TensorProto.BOOL, []),
            helper.make_tensor_value_info("after", TensorProto.FLOAT, None),
        ],
    ),
)


def torn() -> ModelProto:
    """Weights of whose shape the file has no values."""
    model = onnx_network()
    model.graph.initializer[0].dims[0] = 10**12
    return model


def own_operator() -> ModelProto:
    model = onnx_network()
    function = model.functions.add()
    function.name, function.domain = "Conv", "mine"
    return model


REFUSED: dict[str, tuple[Callable[[], ModelProto], str]] = {
    "custom operator": (
        lambda: onnx_network([node("Open", ["images"], "maps", domain="evil")], domains=["evil"]),
        "operator evil.Open, which is not of the standard",
    ),
    "own operator": (own_operator, "defines operators of its own"),
    "loop": (
        lambda: onnx_network([LOOP], tensors=[numpy_helper.from_array(np.array(2**60), "count")]),
        "has a Loop",
    ),
    "chance": (lambda: onnx_network([node("RandomNormalLike", ["images"], "maps")]), "other values each time"),
    "weights without values": (torn, "have 4608 bytes, not the"),
    "enormous shape": (
        lambda: onnx_network(
            [node("ConstantOfShape", ["shape"], "much"), node("Add", ["images", "much"], "maps")],
            tensors=[numpy_helper.from_array(np.array([2**20, 2**20]), "shape")],
        ),
        "does not compute a frame|cannot compute it|too much memory",
    ),
    "not finite": (lambda: onnx_network([node("Log", ["images"], "maps")]), "not finite"),
    "constant": (
        lambda: onnx_network([node("Sub", ["images", "images"], "maps")]),
        "the same for every frame",
    ),
    "another input": (lambda: onnx_network(shape=(1, 3, 48, 48)), "not 1 x 3 x 32 x 32 as it is described"),
    "bytes in": (lambda: onnx_network(kind=TensorProto.UINT8), "not of float32"),
    "a vector out": (
        lambda: onnx_network([node("ReduceMean", ["images"], "maps", axes=[2, 3], keepdims=0)]),
        r"gives \[1, 3\], which is no maps",
    ),
    "numbers out": (
        lambda: onnx_network([node("Cast", ["images"], "maps", to=TensorProto.INT32)]),
        "no floating-point numbers|cannot compute it",
    ),
    "no input left": (lambda: onnx_network([node("Conv", ["other", "w"], "maps")]), "cannot compute it"),
}


def branch(name: str, shape: list[int]) -> GraphProto:
    """Adds up zeros of a shape."""
    nodes = [node("ConstantOfShape", [f"{name} shape"], f"{name} zeros"), node("ReduceSum", [f"{name} zeros"], name)]
    value = helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
    return helper.make_graph(nodes, name, [], [value], [numpy_helper.from_array(np.array(shape), f"{name} shape")])


BRIGHT = [
    node("ReduceMean", ["images"], "mean", keepdims=0),
    node("Greater", ["mean", "limit"], "bright"),
]
LIMIT = numpy_helper.from_array(np.array(1e6, np.float32), "limit")
"""No picture of a trial is so bright."""

COUNT = [*BRIGHT, node("Cast", ["bright"], "number", to=TensorProto.INT64), node("Unsqueeze", ["number", "0"], "count")]
FURTHER = [LIMIT, numpy_helper.from_array(np.array([0]), "0"), numpy_helper.from_array(np.array(2, np.float32), "two")]

OF_THE_PICTURE: dict[str, list[NodeProto]] = {
    "a branch": [
        *BRIGHT,
        helper.make_node(
            "If", ["bright"], ["more"], then_branch=branch("huge", [700_000_000]), else_branch=branch("small", [1])
        ),
    ],
    "a shape": [*COUNT, node("ConstantOfShape", ["count"], "zeros"), node("ReduceSum", ["zeros"], "more")],
    "an expansion": [*COUNT, node("Expand", ["two", "count"], "twos"), node("ReduceSum", ["twos"], "more")],
    "repeats": [
        *COUNT,
        node("Reshape", ["mean", "count"], "one"),
        node("Tile", ["one", "count"], "means"),
        node("ReduceSum", ["means"], "more"),
    ],
    "a range": [*BRIGHT, node("Range", ["limit", "mean", "two"], "steps"), node("ReduceSum", ["steps"], "more")],
    "bright pixels": [
        node("NonZero", ["images"], "pixels"),
        node("Transpose", ["pixels"], "rows", perm=[1, 0]),
        node("MatMul", ["rows", "pixels"], "square"),
        node("Cast", ["square"], "floats", to=TensorProto.FLOAT),
        node("ReduceSum", ["floats"], "more"),
    ],
    "a member of a list": [
        *COUNT,
        helper.make_node("SequenceConstruct", ["images", "two"], ["list"]),
        node("SequenceAt", ["list", "number"], "member"),
        node("ReduceSum", ["member"], "more"),
    ],
}


@pytest.mark.parametrize("what", OF_THE_PICTURE)
def test_no_size_depends_on_the_picture(what: str) -> None:
    """A network that needs little for the pictures of its trial, and much for one that is brighter."""
    nodes = [CONVOLUTION, *OF_THE_PICTURE[what], node("Add", ["maps", "more"], "sum")]
    graph = onnx_network(nodes, "sum", tensors=FURTHER).SerializeToString()
    with pytest.raises(InvalidModel, match=r"If with a graph in it|depends on the picture|SequenceConstruct"):
        OnnxNetwork("growing", graph, MAPS)


@pytest.mark.thorough
def test_sizes_may_depend_on_the_size_of_the_input(tmp_path: Path) -> None:
    """As exporters write them for an input of any size: from its shape, over numbers, to where a shape is needed."""
    nodes = [
        CONVOLUTION,
        node("Shape", ["maps"], "shape"),
        node("Gather", ["shape", "0"], "batch"),
        node("Concat", ["batch", "six", "all"], "flat shape", axis=0),
        node("Reshape", ["maps", "flat shape"], "flat"),
        node("Expand", ["two", "shape"], "twos"),
        node("Reshape", ["flat", "shape"], "again"),
        node("Add", ["again", "twos"], "sum"),
    ]
    extra = [
        numpy_helper.from_array(np.array([0]), "0"),
        numpy_helper.from_array(np.array([6]), "six"),
        numpy_helper.from_array(np.array([-1]), "all"),
        numpy_helper.from_array(np.array(2, np.float32), "two"),
    ]
    graph = import_onnx(write(tmp_path, onnx_network(nodes, "sum", tensors=extra)), MAPS)
    images = as_array(torch.randn(1, 3, SIDE, SIDE))
    plain = OnnxNetwork("plain", onnx_network().SerializeToString(), MAPS)
    assert np.allclose(OnnxNetwork("any size", graph, MAPS)(images)[0], plain(images)[0] + 2)


@pytest.mark.thorough
@pytest.mark.parametrize("what", REFUSED)
def test_what_no_network_may_do_is_refused(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if what != "enormous shape":  # which is to be met in a process of its own
        use(monkeypatch, onnx_import.__name__)
    make, message = REFUSED[what]
    with pytest.raises(InvalidModel, match=message):
        import_onnx(write(tmp_path, make()), MAPS)


def test_files_of_another_kind_and_size_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, onnx_import.__name__)
    path = tmp_path / "network.onnx"
    for content in (b"PK\x03\x04 a zip", b"\x1f\x8b a gzip", b"", b"\x00" * 1000, b"not a network"):
        path.write_bytes(content)
        with pytest.raises(InvalidModel, match=r"not a file in the ONNX format|not a network in the ONNX format"):
            import_onnx(path, MAPS)
    monkeypatch.setattr(onnx_import, "MAX_GRAPH", 1000)
    with pytest.raises(InvalidModel, match="more than 1000 bytes"):
        import_onnx(write(tmp_path, onnx_network()), MAPS)
    with pytest.raises(InvalidModel, match="no output 'second'; it has maps"):
        monkeypatch.setattr(onnx_import, "MAX_GRAPH", 2**20)
        named = checked(MAPS.model_dump() | {"output": {"kind": "maps", "name": "second"}})
        import_onnx(write(tmp_path, onnx_network()), named)


def test_an_installed_file_with_another_graph_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hidden.network.safetensors"
    (tmp_path / "w").write_bytes(weights().tobytes())
    save_onnx_network(path, "hidden", external(onnx_network(), "w").SerializeToString(), MAPS)
    with pytest.raises(InvalidModel, match=r"hidden\.network.*weights 'w' are outside of the file"):
        load_onnx_network(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InvalidModel, match=r"not a readable network file|cannot be read"):
        open_network(path, ("output",))


def test_a_value_that_is_not_finite_is_never_given_on(tmp_path: Path) -> None:
    root = onnx_network([CONVOLUTION, node("Sqrt", ["maps"], "roots")], "roots")
    network = OnnxNetwork("roots", root.SerializeToString(), MAPS)
    with pytest.raises(InvalidModel, match="not finite"):
        network(as_array(torch.randn(1, 3, SIDE, SIDE)))


def test_descriptions(tmp_path: Path) -> None:
    path = tmp_path / "description.json"
    path.write_text(MAPS.model_dump_json())
    assert read_description(path) == MAPS
    assert not DESCRIPTOR.learned and not MAPS.learned
    for changed in ({"whitening": 4}, {"method": "vlad"}, {"method": "regions"}):
        assert MAPS.model_copy(update={"aggregation": Aggregation(**({"method": "gem"} | changed))}).learned
    fields = MAPS.model_dump()
    for wrong, message in (
        ({"output": Output(kind="descriptor")}, "a descriptor is not aggregated"),
        ({"output": {"kind": "tokens"}}, "patch is needed"),
        ({"output": {"kind": "tokens", "patch": 5}}, "not cut into patches of 5"),
        ({"sizes": {"least": 48, "most": 64}}, "32x32 is not from 48 to 64"),
        ({"further": 1}, "further: Extra"),
        ({"input": SHOWN.model_dump() | {"mean": (float("nan"),) * 3}}, "finite"),
    ):
        with pytest.raises(InvalidModel, match=message):
            checked(fields | wrong)
    with pytest.raises(InvalidModel, match="has no cells"):
        checked(DESCRIPTOR.model_dump() | {"second_stage": {}})
    with pytest.raises(InvalidModel, match="32x32 only"):
        MAPS.at(64, 64)
    ranged = checked(fields | {"sizes": {"least": 16, "most": 64, "multiple": 16}})
    assert isinstance(ranged, NetworkDescription) and ranged.at(64, 48).input.width == 48
    with pytest.raises(InvalidModel, match="steps of 16"):
        ranged.at(40, 48)
    path.write_text("{")
    with pytest.raises(InvalidModel, match=r"description\.json cannot be used"):
        read_description(path)
    path.write_bytes(b" " * 70_000)
    with pytest.raises(InvalidModel, match="too long"):
        read_description(path)
    with pytest.raises(InvalidModel, match="cannot be read"):
        read_description(tmp_path / "none.json")
