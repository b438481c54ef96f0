"""A map's own calibration from a second traverse: ``python -m benchmarks.learning.own_calibration``.

The frames of one walk are asked in the map of the other one, with their place and without it, and the map is
calibrated by the answers: by two stages, and with doubtful answers verified.  The figures are cross-validated.
"""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.day.walks import WalkPair, corridor, lip6
from benchmarks.report import report
from core.errors import CalibrationImpossible
from core.judgement.calibration import Held, Target, fit_map_calibration
from core.judgement.trials import StagedTrials
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import PlaceFields, Pose
from core.recognition.calibration import queries_from_traverse, run_trials
from core.recognition.recognition import enrol
from core.store import Directory, Map

WALKS = {"corridor": corridor, "lip6": lip6}
MOST_QUERIES = 300


@dataclass(frozen=True)
class CalibratedBy:
    """Cross-validated figures of a calibration; the last two are of its probabilities."""

    precision: float | None
    recall: float | None
    false_accept_rate: float | None
    error: float
    brier: float

    @classmethod
    def of(cls, held: Held) -> CalibratedBy:
        """Take the figures of a measurement."""
        return cls(
            held.precision.value,
            held.recall.value,
            held.false_accept_rate.value,
            held.reliability.ece,
            held.reliability.brier,
        )


def walked(map_: Map, encoder: Encoder, walk: WalkPair) -> None:
    """Enrol both traverses, posed by which frames of the other one each shows."""
    for number, data in enumerate(walk.references):
        at = Pose(x=walk.spacing * number, y=0)
        enrol(map_, f"r{number}", data, encoder, PlaceFields(pose=at, sequence="reference"))
    for number, data in enumerate(walk.frames[:MOST_QUERIES]):
        shown = np.flatnonzero(walk.shown[number])
        at = Pose(x=walk.spacing * float(shown.mean()), y=0)
        enrol(map_, f"q{number}", data, encoder, PlaceFields(pose=at, sequence="query"))


def examined(encoder: Encoder, walk: WalkPair, folder: Path, precision: float) -> dict[str, CalibratedBy | str]:
    """The calibrations of a walk's map, by two stages and by three; or why there is none."""
    atlas = Directory(folder)
    map_ = atlas.create("walk", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    walked(map_, encoder, walk)
    snapshot = map_.snapshot()
    queries = queries_from_traverse(map_, snapshot, "query", None, MOST_QUERIES)
    trials = run_trials(map_, encoder, snapshot, queries, encoder.calibration, lambda _done, _all: None)
    target = Target(rule="precision", value=precision)
    told: dict[str, CalibratedBy | str] = {}
    for name, some in (("two stages", StagedTrials(trials.two, trials.two)), ("three stages", trials)):
        try:
            found = fit_map_calibration(some, encoder.calibration, target, "sequence:query")
        except CalibrationImpossible as error:
            told[name] = str(error)
        else:
            told[name] = CalibratedBy.of(found.measurement.cross_validated)
    atlas.close()
    return told


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    precision: Annotated[float, typer.Option(help="Share of the recognized answers that is to be right.")] = 0.95,
    encoder: Annotated[str, typer.Option(help="Name of the encoder.")] = DEFAULT_ENCODER,
) -> None:
    """Print a table, and store the figures."""
    chosen, rows, figures = EncoderCatalogue().get(encoder), [], {}
    for name, walk in WALKS.items():
        with tempfile.TemporaryDirectory() as folder:
            told = examined(chosen, walk(datasets), Path(folder), precision)
        for stages, one in told.items():
            values = list(asdict(one).values()) if isinstance(one, CalibratedBy) else [None] * 5
            rows.append((f"{name}, {stages}", *("" if value is None else f"{value:.3f}" for value in values)))
        figures[name] = {stages: one if isinstance(one, str) else asdict(one) for stages, one in told.items()}
    columns = ("", "precision", "recall", "strangers", "calibration error", "Brier score")
    report("own-calibration", f"{chosen.name}: calibrated for a precision of {precision:.2f}", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
