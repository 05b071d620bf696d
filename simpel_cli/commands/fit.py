"""`simpel fit`: a posterior from measured transitions, with a simulator as prior."""

from simpel_cli.commands.options import Cfg, ConfigDir, Multirun, Overrides, Resume
from simpel_cli.commands.starting import launch, refuse_more


def fit(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    resume: Resume = None,
) -> None:
    """Fit a model to measurements, with a simulator as prior, and test it on held-out episodes.

    Examples:
      simpel fit experiment=pendulum

      simpel fit --config-dir my sim=rig data=rig data.n_train=50 run.seeds=5
    """
    if resume is not None:
        refuse_more(resume, overrides, config_dir, cfg, multirun)
        from simpel_cli.sweeps.verbs import resume_fit

        resume_fit(resume)
    else:
        from simpel_cli.sweeps.verbs import fit as task

        launch("fit", task, overrides, config_dir, cfg, multirun)
