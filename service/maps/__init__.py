"""Maps: made, calibrated, exported, imported."""
