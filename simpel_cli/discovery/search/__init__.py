"""Which set of effects explains the measurements: trials, score test, selection, held-out gate, disturbances, pairs."""
