"""Whether the simulator with its ranges can explain the training data, before networks are trained."""

import jax
import numpy as np

from simpel_cli.inference.prior_predictive import PriorCheck, check_prior
from simpel_cli.inference.protocols import Bank
from simpel_cli.runs.settings import stream
from simpel_cli.studies.open import Study
from simpel_cli.studies.prepare import Fitted


def prior_check(study: Study, fitted: Fitted) -> PriorCheck | None:
    """Compare the training targets of the first seed with draws of the prior; None where there is nothing to compare.

    Rows with a value at an end of its sensor are left out.
    """
    own = fitted.training[0]
    kept = np.arange(len(own.x)) if own.beyond is None else np.flatnonzero((own.beyond == 0).all(axis=1))
    if not study.prior.uses_simulator or len(kept) == 0:
        return None
    problem = jax.tree.map(lambda a: np.asarray(a[0]), fitted.assembled.problems)
    x, y, bank = own.x[kept], own.y[kept], problem.bank
    if bank is not None:
        bank = Bank(bank.x[kept], bank.samples[kept])
    relative = fitted.relative[0] if fitted.relative else None
    relative = None if relative is None else relative[kept]
    gap_scale = None if study.prior.gap is None else problem.gap_scale
    return check_prior(
        study.system, fitted.assembled.setting, fitted.normaliser, x, y, study.recording.noise_std, gap_scale,
        stream(0, "prior_predictive"), bank, relative, problem.gap_relevance,
    )  # fmt: skip
