"""Which set of effects explains the measurements: calibration, score test, trials, selection, held-out gate."""
