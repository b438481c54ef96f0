"""Networks that others published: what goes into each, what comes out, and who made it.

To add one, add a row.  Their weights are not shipped: a user imports the authors' checkpoint, or their network exported
to the ONNX format (docs/how-to/bring-your-own-network.md).  Sizes and dimensions are those of the authors' code and
papers; the tests run small networks of each layout, with random weights.
"""

from __future__ import annotations

from typing import Any

from core.frames.preprocessing import InputDefinition
from core.networks.description import Aggregation, NetworkDescription, Output, Sizes

IMAGENET: dict[str, Any] = {
    "channel_order": "rgb",
    "mean": tuple(255 * value for value in (0.485, 0.456, 0.406)),
    "scale": tuple(1 / (255 * value) for value in (0.229, 0.224, 0.225)),
    "resize": "area",
}
"""Mean and deviation of ImageNet's pictures, by which all of these networks normalize theirs."""

DESCRIPTOR = Output(kind="descriptor")
PATCHES = Sizes(least=112, most=1022, multiple=14)
"""Of a ViT that sees patches of 14 pixels."""


def _input(side: int) -> InputDefinition:
    return InputDefinition(height=side, width=side, **IMAGENET)


PUBLISHED: dict[str, NetworkDescription] = {
    # ResNet-18 to 152 or VGG-16, GeM, a linear layer: 32 to 2048 values.  Trained on crops of 512 pixels.
    "cosplace": NetworkDescription(
        input=_input(512),
        output=DESCRIPTOR,
        sizes=Sizes(least=64, most=2048),
        citation="Berton, Masone, Caputo: Rethinking Visual Geo-localization for Large-Scale Applications, CVPR 2022",
    ),
    # The layout of CosPlace: 128 to 2048 values.
    "eigenplaces": NetworkDescription(
        input=_input(512),
        output=DESCRIPTOR,
        sizes=Sizes(least=64, most=2048),
        citation="Berton, Trivigno, Caputo, Masone: EigenPlaces: Training Viewpoint Robust Models for Visual Place "
        "Recognition, ICCV 2023",
    ),
    # ResNet-50 to its third group, whose 20 x 20 maps are mixed whole: 4096 values (also 512 and 128).
    "mixvpr": NetworkDescription(
        input=_input(320),
        output=DESCRIPTOR,
        citation="Ali-bey, Chaib-draa, Giguère: MixVPR: Feature Mixing for Visual Place Recognition, WACV 2023",
    ),
    # DINOv2 ViT-B/14; 64 clusters of 128 values by optimal transport, and 256 of the class token: 8448 values.
    "salad": NetworkDescription(
        input=_input(322),
        output=DESCRIPTOR,
        sizes=PATCHES,
        citation="Izquierdo, Civera: Optimal Transport Aggregation for Visual Place Recognition, CVPR 2024",
    ),
    # DINOv2 ViT-B/14 at 322 pixels, 12 288 values; or ResNet-50 at 384, 16 384 values.  Its second output is attention.
    "boq": NetworkDescription(
        input=_input(322),
        output=DESCRIPTOR,
        sizes=Sizes(least=112, most=1022, multiple=2),
        citation="Ali-bey, Chaib-draa, Giguère: BoQ: A Place is Worth a Bag of Learnable Queries, CVPR 2024",
    ),
    # DINOv2 ViT-B/14 with adapters; 14 vectors of 768 values of a pyramid of its 16 x 16 patches: 10 752 values.  It
    # compares the pictures of a batch with each other; here each is alone.
    "cricavpr": NetworkDescription(
        input=_input(224),
        output=DESCRIPTOR,
        citation="Lu, Lan, Zhang, Jiang, Wang, Yuan: CricaVPR: Cross-image Correlation-aware Representation Learning "
        "for Visual Place Recognition, CVPR 2024",
    ),
    # SALAD with 64 clusters of 256 values, and a linear layer: 8448 values.
    "megaloc": NetworkDescription(
        input=_input(322),
        output=DESCRIPTOR,
        sizes=PATCHES,
        citation="Berton, Masone: MegaLoc: One Retrieval to Place Them All, CVPR Workshops 2025",
    ),
    # The patches' values within layer 31 of DINOv2 ViT-G/14, 1536 each; 32 words: 49 152 values.  The exported graph
    # gives them without the class token; the vocabulary is fitted to the user's pictures.
    "anyloc": NetworkDescription(
        input=_input(322),
        output=Output(kind="tokens", patch=14),
        aggregation=Aggregation(method="vlad", words=32),
        sizes=PATCHES,
        citation="Keetha, Mishra, Karhade, Jatavallabhula, Scherer, Krishna, Garg: AnyLoc: Towards Universal Visual "
        "Place Recognition, IEEE Robotics and Automation Letters 9(2), 2024",
    ),
}
