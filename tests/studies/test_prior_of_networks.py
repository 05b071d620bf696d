"""Whether networks hold the prior that they are given: what a policy drives by before anything was measured."""

from pathlib import Path

import jax
import numpy as np
import pytest
from command_line import simpel

from simpel_cli.config.resolved import load
from simpel_cli.data import transitions
from simpel_cli.evaluation import test_arrays as arrays_of
from simpel_cli.reporting.fit import SCREEN
from simpel_cli.studies.declared import declare
from simpel_cli.studies.fit import learned
from simpel_cli.studies.open import open_study
from simpel_cli.studies.prepare import posteriors


@pytest.mark.slow
def test_the_posterior_of_no_data_turns_with_the_steering(tmp_path: Path) -> None:
    """Over recorded drives the mean of the networks is that of the simulators that they stand for, output by output.

    Along the gradient, without Newton's direction, 18 % of the variance of `omega` are learned in as many steps (97 % with it).
    """
    words = ("fit", "experiment=rc_car_parking", "data.n_train=0", "method.precondition=true")
    result = simpel(
        tmp_path,
        *words,
        "method.pool=1024",
        "method.sets=128",
        "prior.draws=256",
        "hydra.run.dir=run",
        "run.figures=false",
    )
    assert result.code == 0, result.err
    study = open_study(declare(load(tmp_path / "run" / "config.yaml")), tmp_path)
    model = learned(study, tmp_path / "run", SCREEN, shown=False)
    study = model.study
    encoding = study.system.encoding
    x = arrays_of(transitions(study.recording.train, encoding.stack), encoding)[0][::20]
    simulated = study.system.simulate(jax.random.key(1), x, 128).mean(axis=0)
    mean = np.asarray(posteriors(study, model.fitted, model.state)[0].predict(x).mean)
    mean = mean.mean(axis=0) if mean.ndim == 3 else mean
    shares = 1 - ((mean - simulated) ** 2).mean(axis=0) / simulated.var(axis=0)
    assert shares.min() > 0.6, dict(zip(encoding.y_names, shares.round(3).tolist(), strict=True))
