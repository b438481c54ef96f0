"""Every system that can be compared, by name: the encoders installed here and the systems of the literature.

To add a system, add a row to ``BASELINES``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from core.errors import InvalidModel, MissingWeights, UnknownEncoder
from core.method.catalogue import EncoderCatalogue, EncoderSummary
from core.networks.files import open_network
from core.recognition.question import Verify
from lab.baselines import (
    calc,
    compact,
    convnets,
    cross_region,
    fabmap,
    hog,
    netvlad,
    pooling,
    seqslam,
)
from lab.baselines.attention import attentive_attention, context_flexible_attention, fix_context
from lab.baselines.encoders import EncoderSystem, about_encoder
from lab.baselines.stages import (
    FIRST_STAGE,
    TWO_STAGES,
    VERIFIED,
    VerifiedSystem,
    about_first_stage,
    about_two_stages,
    about_verified,
    first_stage,
)
from lab.baselines.system import About, Resources, System


@dataclass(frozen=True)
class Baseline:
    """One row: the description of a system, known without reading a weight, and its making, once per evaluation."""

    about: About
    build: Callable[[About, Resources], System]


BASELINES: tuple[Baseline, ...] = (
    Baseline(cross_region.VLAD, cross_region.build_vlad),
    Baseline(cross_region.BOW_10K, cross_region.build_bow),
    Baseline(cross_region.BOW_2_6K, cross_region.build_bow),
    Baseline(pooling.RMAC, pooling.pooled(pooling.rmac, pooling.LATE)),
    Baseline(cross_region.RMAC_MUTUAL, cross_region.build_rmac_mutual),
    Baseline(pooling.SPP, pooling.pooled(pooling.spatial_pyramid_pool, pooling.LATE)),
    Baseline(pooling.SUM_POOL, pooling.pooled(pooling.sum_pool, pooling.LATE)),
    Baseline(pooling.MAX_POOL, pooling.pooled(pooling.max_pool, pooling.LATE)),
    Baseline(pooling.CROSS_POOL, pooling.pooled(pooling.cross_pool, pooling.EARLY, pooling.LATE)),
    Baseline(pooling.WHOLE, pooling.pooled(pooling.flatten, pooling.LATE)),
    Baseline(hog.ABOUT, hog.build),
    Baseline(seqslam.ABOUT, seqslam.build),
    Baseline(fabmap.ABOUT, fabmap.build),
    Baseline(netvlad.ABOUT, netvlad.build),
    Baseline(convnets.ALEXNET, convnets.build_alexnet),
    Baseline(convnets.AMOSNET, convnets.build_pyramid),
    Baseline(convnets.HYBRIDNET, convnets.build_pyramid),
    Baseline(convnets.PLACES365, convnets.build_places365),
    Baseline(calc.ABOUT, calc.build),
    Baseline(compact.MOBILENET, compact.build),
    Baseline(compact.SQUEEZENET, compact.build),
    Baseline(fix_context.ABOUT, fix_context.build),
    Baseline(attentive_attention.ABOUT, attentive_attention.build),
    Baseline(context_flexible_attention.ABOUT, context_flexible_attention.build),
)
"""The systems of other authors, in the order in which they are listed."""


def systems(models: EncoderCatalogue) -> list[About]:
    """All systems that ``build`` knows, without reading weights: installed encoders, the default first, then others.

    An encoder of two stages stands there as the service asks it, with one stage, with two, and always verified.
    """
    summaries = sorted(models.describe(), key=lambda summary: not summary.default)
    names = {summary.name for summary in summaries}
    own = []
    for summary in summaries:
        about = about_encoder(summary)
        if not has_second_stage(summary):
            own.append(about)
            continue
        always = about_verified(replace(about, name=about.name + VERIFIED))
        others = about_first_stage(about), about_two_stages(about), always
        own += [about_verified(about, "auto"), *(other for other in others if other.name not in names)]
    return own + [baseline.about for baseline in BASELINES]


def has_second_stage(summary: EncoderSummary) -> bool:
    """Whether an installed encoder compares cells of frames, too."""
    return summary.definition is not None and summary.definition.agreement is not None


def build(name: str, *, models: EncoderCatalogue, weights: Path | None = None, verify: Verify = "auto") -> System:
    """Make a system ready to describe frames, or to be trained first if it is ``Trainable``.

    Args:
        name: of a system, or the name or identity of an installed encoder.  An encoder of two stages has a third, as
            the service asks it; with ``.first-stage`` or ``.two-stages`` behind the name it has fewer, and with
            ``.verified`` the third always verifies.
        weights: the file that the system needs; for a system that runs on the packaged network,
            another network file to run on.
        verify: when the third stage of an encoder verifies, if it is queried as by the service.

    Raises:
        MissingWeights: it needs a file and none was given, or there is no such file.
        UnknownEncoder: nothing has this name; the text lists the names that exist.
        InvalidModel: a file cannot be used.
    """
    baseline = next((baseline for baseline in BASELINES if baseline.about.name == name), None)
    if baseline is None:
        return _encoder(name, models, weights, verify)
    if weights is not None and not weights.is_file():
        raise MissingWeights(f"{name}: there is no file {weights}.")
    if weights is None and baseline.about.weights is not None:
        raise MissingWeights(f"{name} needs --weights {name}=FILE, {baseline.about.weights.rstrip('.')}.")
    return baseline.build(baseline.about, Resources(models, weights))


def _encoder(name: str, models: EncoderCatalogue, weights: Path | None, verify: Verify) -> System:
    summaries = {summary.name: summary for summary in models.describe()}
    requested, stages = name, ""
    for ending in (FIRST_STAGE, TWO_STAGES, VERIFIED):
        whole = summaries.get(name.removesuffix(ending))
        if name not in summaries and whole is not None and has_second_stage(whole):
            requested, stages = whole.name, ending
    summary = summaries.get(requested.partition("@")[0])
    if summary is None:
        known = [about.name for about in systems(models)]
        raise UnknownEncoder(f"no system {name[:80]!r} is known; there are {', '.join(known)}.")
    if weights is not None:
        raise InvalidModel(f"{summary.name} is an installed encoder and takes no file of weights.")
    encoder, about = models.get(requested), about_encoder(summary)
    if stages == FIRST_STAGE:
        network = open_network(models.network_file(summary.network), encoder.definition.layers)
        return EncoderSystem(first_stage(encoder, network), about_first_stage(about))
    if stages:
        about = replace(about, name=about.name + stages)
    if stages == VERIFIED:
        return VerifiedSystem(encoder, about_verified(about), "always")
    if stages == TWO_STAGES or verify == "never" or not has_second_stage(summary):
        return EncoderSystem(encoder, about)
    return VerifiedSystem(encoder, about_verified(about, verify), verify)
