"""`simpel simulate`: measurements made by a simulator."""

from simpel_cli.commands.options import Cfg, ConfigDir, Overrides
from simpel_cli.commands.starting import launch


def simulate(overrides: Overrides = None, config_dir: ConfigDir = None, cfg: Cfg = None) -> None:
    """Make measurements with a simulator or a MuJoCo world: a Parquet file, and a card that says how it was made.

    Examples:
      simpel simulate sim=pendulum_world out=data/pendulum

      simpel simulate --config-dir my sim=rig simulation.episodes=20 simulation.seed=1 out=my/data/rig
    """
    from simpel_cli.studies.simulate import simulate as task

    launch("simulate", task, overrides, config_dir, cfg)
