"""Poses between places that stand far apart, on a street with measured poses where it is at hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.geometry.spacing import measured_traverse, outcome
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from tests.service.server import ROOT

STREET = ROOT.parent / "shared" / "datasets" / "eval" / "kitti_short"


@pytest.mark.thorough
@pytest.mark.skipif(not STREET.is_dir(), reason="the evaluation images are not at hand")
def test_the_covariance_covers_the_errors_and_these_are_small() -> None:
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    street = measured_traverse(encoder, STREET)
    # Metres from frame to frame: 1.2.  Where the best match alone told how far it is, errors were 0.3, 0.67 and 1.7 m.
    for spacing, most, least_places in ((6, 0.2, 3.2), (8, 0.45, 2.8), (12, 1.2, 1.5)):
        found = outcome(encoder, street, spacing, 2, "auto")
        # At 14 m, four frames of 77 fit no place well enough to be recognized.
        assert len(found.distances) >= (0.95 if spacing < 12 else 0.9) * len(found.asked)
        assert np.median(found.positions.errors) <= most
        assert 0.15 < np.mean(found.positions.normalized) < 2.2
        assert np.mean(found.headings.normalized) < 2
        assert np.mean(found.places) >= least_places, "of the neighbours, too, though the best match was enough"
        # Every 10 m, 4 of 11 shifts point backwards.
        assert all((metres or 0) < 0.5 for _, metres in found.surveys), "exact poses are found exact"
