"""A fit whose noise goes with the input: roll-outs of policies and the exported predictor have it."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from command_line import rig, simpel

from simpel_cli.control.agents.sac import SAC
from simpel_cli.control.assignment import Assignment
from simpel_cli.control.posterior_world import world_of_posterior
from simpel_cli.control.settings import Control
from simpel_cli.control.task import Task
from simpel_cli.export.predictor import Predictor
from simpel_cli.studies.declared import declare
from simpel_cli.studies.fit import Learned
from simpel_cli.studies.open import open_study
from simpel_cli.studies.prepare import posteriors, prepare
from simpel_cli.studies.training import checkpointed_state

FEW = ("method=map", "method.steps=20", "method.network.hidden=[8]", "method.pool=64", "prior.draws=32", "run.figures=false",
       "run.quiet=true")  # fmt: skip


def test_the_noise_of_where_a_policy_drives(tmp_path: Path) -> None:
    rig(tmp_path)
    scale = "data.noise={law: gaussian, scale: {v: '0.2 + u**2'}}"
    done = simpel(tmp_path, "fit", "--config-dir", "my", "sim=cart", "data=rig", *FEW, scale, "hydra.run.dir=run")
    assert done.code == 0, done.err
    assert simpel(tmp_path, "export", "run").code == 0
    folder = tmp_path / "run" / "export"
    assert json.loads((folder / "posterior.json").read_text())["noise_scale"] == {"v": "0.2 + u**2"}
    predictor = Predictor(folder)

    study = open_study(declare(yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())), tmp_path / "run")
    _, state, fitted = checkpointed_state(tmp_path / "run", prepare(study))
    posterior, encoding = posteriors(study, fitted, state)[0], study.system.encoding
    task = Task(reward="-s**2", horizon=5, initial={"s": [-0.1, 0.1]})
    asked = Assignment(
        task, encoding, task.bind(encoding), Control(sampling="tsinf"), SAC(), None, study.declared.source, None, ""
    )
    of_seed = jax.tree.map(lambda a: a[0], (fitted.assembled.problems, state))
    world = world_of_posterior(Learned(study, fitted, state), asked)(of_seed, 0.0)
    begun = world.reset(jax.random.key(0), 4000)
    begun = begun._replace(encoded=jnp.zeros_like(begun.encoded))
    step, found = jax.jit(world.step), []
    for action in (0.0, 1.0):
        u = 3 * action
        after = step(jax.random.key(1), begun, jnp.full((4000, 1), action, begun.encoded.dtype)).situation.encoded
        predicted = posterior.predict(np.array([[0.0, 0.0, u]]))
        noise = np.asarray(predicted.noise_std)[0]
        np.testing.assert_allclose(np.std(np.asarray(after), axis=0), noise, rtol=0.05)
        told = predictor.step({"s": 0.0, "v": 0.0}, {"u": u}).std
        np.testing.assert_allclose([told["s"], told["v"]], np.asarray(predicted.std)[0], rtol=1e-4)
        found.append(noise)
    np.testing.assert_allclose(found[1] / found[0], [1, (0.2 + 9) / 0.2], rtol=1e-4)
