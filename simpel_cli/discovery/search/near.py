"""Whether a model's errors ahead are near the measurement noise: farther than that something is missing.

Where states are unstable, errors ahead are large though nothing is missing; then there is no noise of the process.
"""

import numpy as np

from simpel_cli.discovery.search.trials import Search, Trial
from simpel_cli.filtering.errors_ahead import Assessor, rmse
from simpel_cli.filtering.setup import Q_BOUNDS

NEAR = 3.0  # times the measurement noise: errors so small are near the floor
QUIET = 0.01  # typical rates: so little noise of the process makes up for nothing


def far(search: Search, assessor: Assessor, trial: Trial) -> bool:
    """Whether noise of the process is needed, and the error of a channel some rows ahead far above the noise.

    Args:
        search: whose measurements are looked at.
        assessor: of errors ahead.
        trial: the model.
    """
    coordinates, z = search.plan.coordinates, trial.optimum.z
    n_p, n_r, n_q = coordinates.sizes
    process = range(n_p + n_r, n_p + n_r + n_q)
    if all(coordinates.value(i, float(z[i])) < coordinates.value(i, 0.0) * QUIET / Q_BOUNDS[0] for i in process):
        return False
    windows = search.plan.windows
    found = assessor(z, windows)
    if not np.isfinite(np.asarray(found.track.innovation)[windows.ok > 0]).all():  # it ran away
        return True
    known = np.isfinite(found.ahead).any(axis=(0, 1))
    if not known.any():  # windows without a row so far ahead
        return False
    noise = np.array([coordinates.value(i, float(z[i])) for i in range(n_p, n_p + n_r)])
    return bool(np.any(rmse(found.ahead[..., known]) > NEAR * noise[known]))
