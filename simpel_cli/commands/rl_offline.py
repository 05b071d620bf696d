"""`simpel rl-offline`: a policy from recorded transitions."""

from simpel_cli.commands.options import Cfg, ConfigDir, Multirun, Overrides, Resume
from simpel_cli.commands.starting import launch, refuse_more


def rl_offline(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    resume: Resume = None,
) -> None:
    """Learn a control policy from recorded measurements, and test it in a simulator that stands for the real system.

    Examples:
      simpel rl-offline experiment=rc_car_parking data.n_train=200

      simpel rl-offline --config-dir my sim=rig data=rig reward=my_task sim@truth=rig_as_i_know_it
    """
    if resume is not None:
        refuse_more(resume, overrides, config_dir, cfg, multirun)
        from simpel_cli.sweeps.verbs import resume_rl_offline

        resume_rl_offline(resume)
    else:
        from simpel_cli.sweeps.verbs import rl_offline as task

        launch("rl-offline", task, overrides, config_dir, cfg, multirun)
