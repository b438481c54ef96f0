"""The definitions of the packaged encoders; their vocabularies are trained for these.

The quantisation steps fit the packaged network, whose activations are of the order of one.  The thesis's networks have
activations of tens to hundreds and a step of 1.0, at which a layer has 10 000 to 22 000 regions.  The packaged network
has 13 000 to 14 000 of them (medians; 8 000 to 16 000) at a step of 0.1, which its presets of the thesis take.
"""

from __future__ import annotations

from core.method.agreement import AgreementDefinition
from core.method.encoder import EncoderDefinition

NETWORK = "placerec-hybrid"
"""The packaged backbone."""

PRESETS: dict[str, EncoderDefinition] = {
    # Thesis, chapter 4: N = 300 regions of conv3 and of conv4, V = 128.  Ours: features of unit length, projected, a
    # coarse step (about 500 regions a layer), and a second stage.
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
            weights=(0.35, 0.4, 0.25),
            reach=(2, 5),
            candidates=30,
            share=0.83,
            centred=0.75,
            screened=100,
            taught=True,
        ),
    ),
    # The same as in the thesis: regional features as they are, and no second stage.
    "m-region-vlad-thesis": EncoderDefinition(
        layers=("conv3", "conv4"),
        regions=300,
        steps=(0.1, 0.1),
        unit_features=False,
        words=128,
        gamma=0.5,
        normalization="intra",
    ),
    # Thesis, chapter 3: N = 400 regions of conv3, V = 256, regional features as they are.
    "region-vlad": EncoderDefinition(
        layers=("conv3",),
        regions=400,
        steps=(0.1,),
        unit_features=False,
        words=256,
        gamma=0.5,
        normalization="intra",
    ),
}
