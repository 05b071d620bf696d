"""The gate: what a set of effects has to show on parts that it was not fitted to."""
