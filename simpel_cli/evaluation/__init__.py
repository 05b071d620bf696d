"""How good a posterior is on held-out episodes: one step ahead and in free run, with bootstrap intervals."""

from simpel_cli.evaluation.bootstrap import Blocks, Estimate, blocks_of, bootstrap
from simpel_cli.evaluation.free_run import FreeRun, free_run, free_run_table, windows
from simpel_cli.evaluation.one_step import LEVELS, OneStep, chi_squared_quantile, one_step, one_step_table
from simpel_cli.evaluation.posterior import CHUNK, Posterior, test_arrays

__all__ = [
    "CHUNK", "LEVELS", "Blocks", "Estimate", "FreeRun", "OneStep", "Posterior", "blocks_of", "bootstrap",
    "chi_squared_quantile", "free_run", "free_run_table", "one_step", "one_step_table", "test_arrays", "windows",
]  # fmt: skip
