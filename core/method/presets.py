"""The definitions of the packaged encoders; their vocabularies are trained for these.

The quantisation steps fit the packaged network, whose activations are of the order of one.  A network with Caffe's
scale (tens to hundreds) needs a step of 1.0.
"""

from __future__ import annotations

from core.method.agreement import AgreementDefinition
from core.method.encoder import EncoderDefinition

NETWORK = "placerec-hybrid"
"""The packaged backbone."""

PRESETS: dict[str, EncoderDefinition] = {
    # Thesis, chapter 4: N = 300 regions of conv3 and of conv4, V = 128.  Ours: features projected, and a second stage.
    "m-region-vlad": EncoderDefinition(
        layers=("conv3", "conv4"),
        regions=300,
        steps=(2.0, 2.0),
        unit_features=True,
        projection=128,
        words=128,
        gamma=0.5,
        normalization="intra",
        agreement=AgreementDefinition(
            layers=("pool2", "conv3", "conv4"),
            values=64,
            weights=(0.4, 0.4, 0.2),
            reach=(2, 5),
            candidates=30,
            share=0.75,
        ),
    ),
    # The same as in the thesis: regional features as they are, and no second stage.
    "m-region-vlad-thesis": EncoderDefinition(
        layers=("conv3", "conv4"),
        regions=300,
        steps=(2.0, 2.0),
        unit_features=False,
        words=128,
        gamma=0.5,
        normalization="intra",
    ),
    # Thesis, chapter 3: N = 400 regions of conv3, V = 256, without a second stage.
    "region-vlad": EncoderDefinition(
        layers=("conv3",),
        regions=400,
        steps=(2.0,),
        unit_features=True,
        words=256,
        gamma=0.5,
        normalization="intra",
    ),
}
