"""The graph of XFeat: the packaged file is what the module writes, and what is folded computes as it did before."""

from __future__ import annotations

import numpy as np
import torch
from onnx import TensorProto, numpy_helper
from torch.nn import functional as F

from core.networks.onnx_graph import read_graph
from core.networks.xfeat import PACKAGED_XFEAT
from lab.conversion.xfeat import BLOCK_NAMES, BLOCKS, EPSILON, folded, xfeat_graph


def published() -> dict[str, torch.Tensor]:
    """Random tensors of the names and shapes that the authors' file has."""
    torch.manual_seed(0)
    made: dict[str, torch.Tensor] = {}
    for block, layers in BLOCKS.items():
        for number, layer in enumerate(layers):
            source = f"{BLOCK_NAMES.get(block, block)}.{number + (block == 'skip1')}"
            kernel = torch.randn(layer.outputs, layer.inputs, layer.kernel, layer.kernel)
            if block == "keypoints" and number == 0:  # theirs sees the pixels of a cell as channels
                kernel = kernel.reshape(layer.outputs, -1, 1, 1)
            if layer.rectified:
                made[f"{source}.layer.0.weight"] = kernel
                made[f"{source}.layer.1.running_mean"] = torch.randn(layer.outputs)
                made[f"{source}.layer.1.running_var"] = torch.rand(layer.outputs) + 0.5
            else:
                made[f"{source}.weight"], made[f"{source}.bias"] = kernel, torch.randn(layer.outputs)
    return made


def test_the_packaged_file_is_what_the_module_writes() -> None:
    packaged = PACKAGED_XFEAT.read_bytes()
    tensors = read_graph(packaged).graph.initializer
    weights = {
        tensor.name: numpy_helper.to_array(tensor) for tensor in tensors if tensor.data_type == TensorProto.FLOAT16
    }
    assert xfeat_graph(weights) == read_graph(packaged)


def test_a_folded_convolution_gives_what_it_gave_with_its_normalization() -> None:
    theirs = published()
    made = folded(theirs)
    shown = torch.randn(1, 24, 12, 16)
    plain = F.conv2d(shown, theirs["block2.0.layer.0.weight"], padding=1)
    mean, variance = theirs["block2.0.layer.1.running_mean"], theirs["block2.0.layer.1.running_var"]
    wanted = F.batch_norm(plain, mean, variance, eps=EPSILON)
    kernel, offset = (torch.from_numpy(made[f"block2.0.{part}"].astype(np.float32)) for part in ("weight", "bias"))
    torch.testing.assert_close(F.conv2d(shown, kernel, offset, padding=1), wanted, atol=0.05, rtol=0)
