"""Whether a model's errors ahead are near the measurement noise: farther than that something is missing."""

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor, rmse

NEAR = 3.0  # times the measurement noise: errors so small are near the floor


def far(search: Search, assessor: Assessor, trial: Trial) -> bool:
    """Whether the error of any channel some rows ahead, in the measurements of the search, is far above its noise."""
    error = rmse(assessor(trial.optimum.z, search.plan.windows).ahead)
    n_p, n_r, _ = search.plan.coordinates.sizes
    noise = np.array([search.plan.coordinates.value(i, float(trial.optimum.z[i])) for i in range(n_p, n_p + n_r)])
    return not bool(np.all(error <= NEAR * noise))
