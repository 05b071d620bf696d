"""`simpel rl-online`: a policy from episodes of its own."""

from simpel_cli.commands.options import Cfg, ConfigDir, Multirun, Overrides, Resume
from simpel_cli.commands.starting import launch, refuse_more


def rl_online(
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
    cfg: Cfg = None,
    multirun: Multirun = False,
    resume: Resume = None,
) -> None:
    """Learn a control policy from nothing: act in the real system, measure, learn a model and a policy, act again.

    Examples:
      simpel rl-online experiment=rc_car_parking online.episodes=10

      simpel rl-online --config-dir my sim=rig reward=my_task world=folder:exchange

      simpel rl-online --resume runs/rl-online/rig/20261121-101502-3fa9 online.episodes=20
    """
    if resume is not None:
        refuse_more(resume, config_dir, cfg, multirun)
        from simpel_cli.sweeps.verbs import resume_rl_online

        resume_rl_online(resume, overrides or [])
    else:
        from simpel_cli.sweeps.verbs import rl_online as task

        launch("rl-online", task, overrides, config_dir, cfg, multirun)
