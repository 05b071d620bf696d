"""Inference rules, one per file; each binds a problem and returns `init`, `step` and `predict` (`inference.protocols`)."""
