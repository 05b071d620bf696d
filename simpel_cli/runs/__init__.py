"""What surrounds a computation: run directory, manifest, metrics, checkpoints, interruption, terminal, finding runs."""
