"""Several systems on one pair of traverses: the whole evaluation, from top to bottom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from core.baselines.encoders import EncoderSystem
from core.baselines.system import System
from core.evaluation.cache import EvaluationCache
from core.evaluation.data.pairs import TraversePair
from core.evaluation.measurement import best_first, run
from core.evaluation.protocol.comparison import Comparison, Run, ScalePoint, SeverityCurve
from core.evaluation.scalability import scalability, scale_steps
from core.evaluation.severity import severity, severity_steps
from core.evaluation.subjects import Load, Subject, Training


class Watch(Protocol):
    """Who is told how far the evaluation is."""

    def begin(self, system: str, steps: int) -> None:
        """A system comes next; it takes ``steps`` steps, or fewer where something was kept."""

    def advance(self) -> None:
        """A picture was learned from, described, or compared."""

    def end(self) -> None:
        """The system is done."""


@dataclass(frozen=True)
class Extras:
    """What is measured besides the figures, and the seed of disturbances."""

    scalability: bool = False
    severity: bool = False
    seed: int = 0


def compare_systems(
    systems: Sequence[System],
    pair: TraversePair,
    training: Training,
    load: Load,
    cache: EvaluationCache,
    watch: Watch,
    extras: Extras = Extras(),
) -> Comparison:
    """Measure each system in turn; each result is kept as soon as it is there.

    Args:
        load: decodes a picture; what it raises ends the run.

    Raises:
        InvalidModel: a system gives no finite scores, or cannot learn from the pictures of ``training``.
    """
    runs: list[Run] = []
    points: list[ScalePoint] = []
    curves: list[SeverityCurve] = []
    for system in systems:
        subject = Subject(system, pair, training, load, watch.advance)
        watch.begin(subject.about.name, _steps(subject, extras))
        runs.append(run(subject, cache))
        if extras.scalability:
            points += scalability(subject, cache)
        if extras.severity:
            curves += severity(subject, cache, seed=extras.seed)
        watch.end()
    ranked = best_first(runs)
    seeing = _best_encoder(systems, ranked)
    return Comparison(
        name=pair.name,
        references=pair.references,
        queries=pair.queries,
        kept=pair.kept,
        truth=pair.truth,
        runs=ranked,
        regions=None if seeing is None else lambda path: seeing.region_boxes(load(path)),
        regions_of=None if seeing is None else seeing.identity,
        scalability=points if extras.scalability else None,
        severity=curves if extras.severity else None,
        notes=list(pair.notes),
    )


def _steps(subject: Subject, extras: Extras) -> int:
    steps = subject.steps
    if extras.scalability:
        steps += scale_steps(subject)
    if extras.severity:
        steps += severity_steps(subject)
    return steps


def _best_encoder(systems: Sequence[System], ranked: Sequence[Run]) -> EncoderSystem | None:
    """The best of the encoders, whose regions are drawn; None without an encoder."""
    encoders = {system.identity: system for system in systems if isinstance(system, EncoderSystem)}
    return next((encoders[one.identity] for one in ranked if one.identity in encoders), None)
