"""Every system that can be compared, by name: the encoders installed here and those of the literature."""

from __future__ import annotations

from pathlib import Path

from core.baselines import attention, calc, convnets, cross_region, fabmap, hog, netvlad, pooling, rmac, seqslam, spp
from core.baselines.encoders import EncoderSystem, about_encoder
from core.baselines.entry import Entry, Ingredients
from core.baselines.system import About, System
from core.errors import InvalidModel, MissingWeights, UnknownEncoder
from core.method.catalogue import EncoderCatalogue

ENTRIES: tuple[Entry, ...] = (
    *cross_region.SYSTEMS,
    *rmac.SYSTEMS,
    *spp.SYSTEMS,
    *pooling.SYSTEMS,
    *hog.SYSTEMS,
    *seqslam.SYSTEMS,
    *fabmap.SYSTEMS,
    *netvlad.SYSTEMS,
    *convnets.SYSTEMS,
    *calc.SYSTEMS,
    *attention.SYSTEMS,
)
"""The systems of other authors, in the order in which they are listed."""


def systems(models: EncoderCatalogue) -> list[About]:
    """All that ``build`` knows: the installed encoders, the default first, then other authors'; no weights are read."""
    own = [about_encoder(summary) for summary in sorted(models.describe(), key=lambda summary: not summary.default)]
    return own + [entry.about for entry in ENTRIES]


def build(name: str, *, models: EncoderCatalogue, weights: Path | None = None) -> System:
    """Make a system ready to describe frames, or to be trained first if it is ``Trainable``.

    Args:
        name: of a system, or the name or identity of an installed encoder.
        weights: the file that the system needs; for a system that runs on the packaged network,
            another network file to run on.

    Raises:
        MissingWeights: it needs a file and none was given, or there is no such file.
        UnknownEncoder: nothing has this name; the text lists what there is.
        InvalidModel: a file cannot be used.
    """
    entry = next((entry for entry in ENTRIES if entry.about.name == name), None)
    if entry is None:
        return _encoder(name, models, weights)
    if weights is not None and not weights.is_file():
        raise MissingWeights(f"{name}: there is no file {weights}.")
    if weights is None and entry.about.weights is not None:
        raise MissingWeights(f"{name} needs --weights {name}=FILE, {entry.about.weights.rstrip('.')}.")
    return entry.build(Ingredients(models, weights))


def _encoder(name: str, models: EncoderCatalogue, weights: Path | None) -> System:
    summaries = {summary.name: summary for summary in models.describe()}
    summary = summaries.get(name.partition("@")[0])
    if summary is None:
        known = [*summaries, *(entry.about.name for entry in ENTRIES)]
        raise UnknownEncoder(f"no system {name[:80]!r} is known; there are {', '.join(known)}.")
    if weights is not None:
        raise InvalidModel(f"{summary.name} is an installed encoder and takes no file of weights.")
    return EncoderSystem(models.get(name), about_encoder(summary))
