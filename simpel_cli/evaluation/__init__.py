"""How good a posterior is on held-out episodes: one step ahead and in free run, with bootstrap intervals."""

from simpel_cli.evaluation.bootstrap import MIN_EPISODES, Blocks, Estimate, blocks_of, bootstrap
from simpel_cli.evaluation.diversity import distinct_particles
from simpel_cli.evaluation.free_run import FreeRun, free_run, free_run_table, windows
from simpel_cli.evaluation.one_step import (
    IN_DATA_UNITS,
    LEVELS,
    MIXED,
    OneStep,
    chi_squared_quantile,
    joint_unit,
    one_step,
    one_step_table,
)
from simpel_cli.evaluation.posterior import CHUNK, Posterior, noise_of, test_arrays

__all__ = [
    "CHUNK", "IN_DATA_UNITS", "LEVELS", "MIN_EPISODES", "MIXED", "Blocks", "Estimate", "FreeRun", "OneStep", "Posterior",
    "blocks_of", "bootstrap", "chi_squared_quantile", "distinct_particles", "free_run", "free_run_table", "joint_unit",
    "noise_of", "one_step", "one_step_table", "test_arrays", "windows",
]  # fmt: skip
