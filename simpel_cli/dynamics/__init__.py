"""Simulators in JAX: CasADi functions interpreted, integrated, as one-step transitions in the coordinates of learning."""
