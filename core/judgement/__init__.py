"""What scores mean: verdicts, probabilities, calibration, priors, positions.  No encoder and no map is known here."""
