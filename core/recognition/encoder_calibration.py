"""The calibration that an encoder ships with, measured on pictures of any places."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from core.errors import CalibrationImpossible
from core.frames.preprocessing import Pixels, second_look
from core.judgement.calibration import fit_encoder_calibration
from core.judgement.verdict import Calibration
from core.method.encoder import Encoder
from core.recognition.stages import score_matrix

UNMEASURED = Calibration(
    source="not-measured", threshold=2.0, margin=0.0, background_mean=0.0, background_deviation=1.0
)
"""Of an encoder before it is calibrated: no decision value reaches its threshold, so that every verdict is unknown."""

NEIGHBOURS = 3
"""Pictures that are at most this many places apart, in their order, may show the same place."""


def measure_calibration(encoder: Encoder, frames: Sequence[Pixels] | Iterable[Pixels], source: str) -> Calibration:
    """The calibration that an encoder ships with, by frames in the order in which they were taken.

    Each is a query as it is, among the others, and as a second visit would see it (``fit_encoder_calibration``).

    Raises:
        CalibrationImpossible: the frames are too few.
    """
    first, second = [], []
    for pixels in frames:
        first.append(encoder.encode(pixels))
        second.append(encoder.encode(second_look(pixels)))
    if len(first) <= NEIGHBOURS + 1:
        raise CalibrationImpossible(f"Only {len(first)} of the images can be decoded; give more.")
    vectors, looks = (np.stack([one.descriptor for one in side]) for side in (first, second))  # n x D
    cells, looked = (np.stack([one.local for one in side]) for side in (first, second))
    unknown = score_matrix(encoder, vectors @ vectors.T, cells, cells)
    known = score_matrix(encoder, looks @ vectors.T, looked, cells)
    return fit_encoder_calibration(unknown, known, NEIGHBOURS, source)
