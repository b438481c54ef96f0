"""The meaning of scores: verdicts, probabilities, calibration, priors, positions.  No encoder or map is known here."""
