"""What scores amount to: verdicts, probabilities, calibration, priors, positions.  Knows no encoder and no map."""
