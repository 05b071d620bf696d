"""`simpel rl-online`: act in the plant, measure, learn a model and a policy, act again."""

import json
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simpel_cli import evaluation as ev
from simpel_cli.commands.control import Assignment, Flown, assignment, remarks, task_table, train
from simpel_cli.commands.fit import Learned, learned
from simpel_cli.commands.rl_offline import OWN, done_steps, saved_policies
from simpel_cli.config.launch import Job
from simpel_cli.config.nodes import build
from simpel_cli.config.resolved import dump, of_run
from simpel_cli.control.online_settings import Online
from simpel_cli.control.plants.environments import GymnasiumRig, WorldRig
from simpel_cli.control.plants.exchange import Exchange
from simpel_cli.control.plants.plant import Plant, Ride, Simulated, Stepped, write_ride
from simpel_cli.control.plants.policy_files import load_policy
from simpel_cli.control.plants.returned_episodes import Answers
from simpel_cli.data import Measurements, Recording, read, transitions
from simpel_cli.errors import ConfigError, DataError, NumericsError, did_you_mean
from simpel_cli.reporting.figures.canvas import columns_of
from simpel_cli.reporting.figures.control import draw_online
from simpel_cli.reporting.html import figure, write_report
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory, refuse_occupied, typed
from simpel_cli.runs.files import write_text
from simpel_cli.runs.interruption import interruption, stop_if
from simpel_cli.runs.manifest import Manifest, read_manifest, refuse_changed_config
from simpel_cli.runs.metrics import MetricStream, write_metrics
from simpel_cli.runs.settings import Settings, configure, stream
from simpel_cli.runs.tensorboard import Scalars
from simpel_cli.studies.study import posteriors, resolved, settings_of, source_of
from simulators.model import Model

WORLDS = "sim, mujoco, gymnasium:ID and folder:DIR"
MEASURED = (
    "noise_std",
    "stack_actions",
    "max_gap",
    "derived",
)  # keys of the data YAML that hold for a plant's episodes


class Loop(NamedTuple):
    """What stays the same from episode to episode."""

    config: dict[str, Any]
    directory: Path
    settings: Settings
    asked: Assignment
    online: Online
    terminal: Terminal
    check: Callable[[], None]  # raises if the user stopped the run


def rl_online(job: Job) -> None:
    """Run in a new directory."""
    for word in job.given:
        group, _, key = word.partition("=")[0].lstrip("+").partition(".")
        if group == "data" and key and key.partition(".")[0] not in MEASURED:
            raise ConfigError(
                f"{word}: rl-online learns from episodes of its own; of data: it takes {', '.join(MEASURED)} only. "
                "To learn from measurements use rl-offline."
            )
    directory = make_directory(job.directory)
    refuse_occupied(directory)
    config = resolved(job)
    kind, _, rest = str(config.get("world")).partition(":")
    if kind == "folder" and rest:  # a resumed run may start elsewhere
        config["world"] = f"folder:{Path(rest).expanduser().absolute()}"
    write_text(directory / "config.yaml", dump(config))
    with Manifest(directory, "rl-online", settings_of(config)) as manifest:
        _run(config, directory, manifest)


def resume(directory: Path, overrides: Sequence[str] = ()) -> None:
    """Go on with an interrupted run: every step that is complete is kept, and the result is the same.

    Args:
        directory: of the run.
        overrides: `online.episodes=N` with more episodes than there were, or nothing.

    Raises:
        ConfigError: not such a run, or other overrides.
    """
    record = read_manifest(directory)
    if record["command"] != "rl-online":
        raise ConfigError(f"{directory}: made by `simpel {record['command']}`, not by rl-online.")
    refuse_changed_config(directory, record)
    config = of_run(directory)
    old = build(config.get("online") or {}, "online", default=Online).episodes
    episodes = _more(overrides, old)
    if episodes > old:
        config["online"] = (config.get("online") or {}) | {"episodes": episodes}
        write_text(directory / "config.yaml", dump(config))
    elif record.get("status") == "done" and _whole(directory, old):
        Terminal(settings_of(config).quiet).line(f"{directory} is complete; nothing to do.")
        return
    with Manifest(directory, "rl-online", settings_of(config)) as manifest:
        _run(config, directory, manifest)


def _more(overrides: Sequence[str], old: int) -> int:
    """Return how many episodes a resumed run has."""
    for word in overrides:
        key, _, value = word.lstrip("+").partition("=")
        if key != "online.episodes" or not value.isdigit() or int(value) < old:
            raise ConfigError(
                f"--resume: got {word}; a resumed run keeps its configuration, but for more episodes: online.episodes=N with N "
                f"of at least {old}."
            )
    return max([old, *(int(word.partition("=")[2]) for word in overrides)])


def _whole(directory: Path, episodes: int) -> bool:
    """Return whether everything is there that a finished run leaves."""
    files = [directory / "report.html", directory / "policy" / "policy.safetensors", directory / "metrics.parquet"]
    return all(
        path.exists() for path in [*files, *(directory / "episodes" / f"{i:03d}.parquet" for i in range(episodes))]
    )


def _run(config: dict[str, Any], directory: Path, manifest: Manifest) -> None:
    settings = settings_of(config)
    if settings.seeds > 1:
        raise ConfigError(
            f"run.seeds: got {settings.seeds}; the episodes of one policy follow each other, so rl-online takes one. Run it "
            "once per run.seed."
        )
    manifest.facts["device"] = str(configure(settings))
    make_directory(directory / "episodes")
    asked = assignment(config, settings)
    online = build(config.get("online") or {}, "online", default=Online)
    terminal = Terminal(settings.quiet, directory / "run.log")
    with interruption() as interrupted:
        loop = Loop(config, directory, settings, asked, online, terminal, lambda: stop_if(interrupted))
        plant = _plant(loop)
        _refuse_wrong_data(loop)
        terminal.line(f"simpel rl-online · {settings.name} · seed {settings.seed}", style="bold")
        terminal.line(
            f"{online.episodes} episodes of {asked.task.horizon} steps in {config['world']}"
            + (f" ({asked.truth_name})" if config["world"] == "sim" else ""),
            "task",
        )
        for remark in remarks(asked):
            terminal.line(remark, "look", style="yellow")
        for number in range(online.episodes):
            _episode(loop, plant, number)
    # the last policy knows most: in its model it earns more than the one before it (online.keep_better)
    shutil.copytree(_folder(loop, online.episodes - 1) / "policy", directory / "policy", dirs_exist_ok=True)
    write_metrics(directory / "metrics.parquet", _rows(loop), _constants(loop))
    _publish(loop)


def _plant(loop: Loop) -> Plant:
    """Return what `world` names.

    Raises:
        ConfigError: no such world, or what it needs is missing.
    """
    config, settings, asked = loop.config, loop.settings, loop.asked
    world = str(config.get("world"))
    kind, _, rest = world.partition(":")
    encoding, goal, horizon, key = asked.encoding, asked.goal, asked.task.horizon, stream(settings.seed, "plant")
    if kind == "sim" and not rest:
        if asked.truth is None:
            raise ConfigError(
                "world: sim needs a true simulator, e.g. sim@truth=parking_car; for a rig use world=folder:DIR."
            )
        actor = asked.policy.bind(asked.truth, horizon, len(encoding.inputs)).actor
        return Simulated(asked.truth, encoding, goal, actor.act, horizon, key)
    if kind == "mujoco" and not rest:
        if not config.get("mujoco"):
            raise ConfigError("world: mujoco needs a MuJoCo world, e.g. sim@mujoco=rc_car_world.")
        source = source_of({"sim": config["mujoco"]}, settings)
        if isinstance(source, Model):
            raise ConfigError(
                f"mujoco: {source.name} is a simulator with equations; use it as sim@truth with world=sim."
            )
        noise = np.array([asked.task.noise_std.get(q.name, 0.0) for q in encoding.states])
        return Stepped(WorldRig(source, encoding, goal, asked.source.dt, noise, key), encoding, goal, horizon)
    if kind == "gymnasium" and rest:
        return Stepped(GymnasiumRig(rest, encoding, settings.seed), encoding, goal, horizon)
    if kind == "folder" and rest:
        return Exchange(
            make_directory(Path(rest), "world", "world=folder:DIR"),
            Answers(encoding, goal, asked.task, asked.source.dt, lambda text: loop.terminal.line(text, "rig")),
            loop.online.wait, _identity(loop.directory), lambda number, ride: _accept(loop, number, ride),
            lambda text: loop.terminal.line(text, "rig"), loop.check,
        )  # fmt: skip
    kinds = ["sim", "mujoco", "gymnasium", "folder"]
    hint = "" if kind in kinds else did_you_mean(kind, kinds)
    raise ConfigError(f"world: got {world!r}; allowed are {WORLDS}.{hint}")


def _identity(directory: Path) -> str:
    """Return what tells this run's requests to a rig from those of others, wherever its directory is moved."""
    path = directory / "exchange_id.txt"
    if not path.exists():
        write_text(path, secrets.token_hex(16))
    return path.read_text()


def _file(loop: Loop, number: int) -> Path:
    return loop.directory / "episodes" / f"{number:03d}.parquet"


def _folder(loop: Loop, number: int) -> Path:
    return loop.directory / "rounds" / f"{number:03d}"


def _episode(loop: Loop, plant: Plant, number: int) -> None:
    """Learn from the episodes before, act, and keep what came of it. What is complete is not done again."""
    path, folder = _file(loop, number), _folder(loop, number)
    if (folder / "round.json").exists():
        if path.exists():
            return
        _withdraw(loop, plant, number)
    make_directory(folder)
    began = time.perf_counter()
    try:
        model = learned(_fit_config(loop, number), folder / "posterior", loop.directory, shown=False)
    except NumericsError as error:
        if not number:
            raise
        raise NumericsError(
            f"{error} The model was being fitted to {number} {'episode' if number == 1 else 'episodes'}: if a sensor failed in "
            f"the last, delete {_file(loop, number - 1)} and go on with --resume; that episode is asked for again."
        ) from error
    fitted = time.perf_counter()
    loop.check()
    flown = _trained(loop, number, model, folder)
    trained = time.perf_counter()
    loop.check()
    if not path.exists():
        write_ride(path, plant.ride(number, folder / "policy"), loop.asked.encoding, loop.asked.source.dt)
    problem = _problem(loop, number, path)
    facts = {
        "return_in_model": float(flown.model_returns[0]),
        "nll_before": _surprise(loop, number, model),
        "broken_in_model": float(flown.broken[0]),
        "fitted": not problem,
        "fit_seconds": round(fitted - began, 3),
        "policy_seconds": round(trained - fitted, 3),
        "episode_seconds": round(time.perf_counter() - trained, 3),
    }
    write_text(folder / "round.json", json.dumps(facts, indent=1))
    found = _facts(loop, number)
    broken = (
        f"   {100 * found['broken_in_model']:.0f} % of the roll-outs in the model diverged"
        if found["broken_in_model"]
        else ""
    )
    loop.terminal.line(
        f"return {found['return']:.4g} (in the model {found['return_in_model']:.4g})"
        + (f"   {'succeeded' if found['success'] else 'not yet'}" if loop.asked.task.success else "")
        + f"   NLL before it was learned {found['nll_before']:.3g}   "
        f"fit {facts['fit_seconds']:.0f} s, policy {facts['policy_seconds']:.0f} s{broken}",
        f"episode {number}",
    )
    if problem:
        loop.terminal.line(f"no model is fitted to this episode: {problem}", f"episode {number}")


def _withdraw(loop: Loop, plant: Plant, number: int) -> None:
    """Forget the last episode, whose file the user has deleted, and what was learned from it.

    Raises:
        ConfigError: it is not the last one.
    """
    later = [i for i in range(number + 1, loop.online.episodes) if _file(loop, i).exists()]
    if later:
        raise ConfigError(
            f"{_file(loop, number)} is missing, but the episodes after it are there ({_file(loop, later[0]).name}, ...), whose "
            "policies were learned from it. Put it back, or begin a new run."
        )
    loop.terminal.line("its file was deleted: what was learned from it is set aside", f"episode {number}")
    (_folder(loop, number) / "round.json").unlink()
    for i in range(number + 1, loop.online.episodes):
        folder = _folder(loop, i)
        if folder.exists():
            count = len(list(folder.parent.glob(f"{folder.name}.withdrawn-*"))) + 1
            folder.rename(folder.with_name(f"{folder.name}.withdrawn-{count}"))
    if isinstance(plant, Exchange):
        plant.withdraw(number)


def _round(loop: Loop, number: int) -> dict[str, Any]:
    """Return what is kept of a round.

    Raises:
        ConfigError: the file is damaged.
    """
    path = _folder(loop, number) / "round.json"
    try:
        found = json.loads(path.read_text())
        if not isinstance(found, dict) or "return_in_model" not in found:
            raise ValueError("not the record of a round")
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: damaged ({error}). Delete it and go on with --resume: it is made anew of what the round has left."
        ) from error
    return found


def _data(loop: Loop, paths: Sequence[Path]) -> dict[str, Any]:
    """Return the data YAML of episodes."""
    own = {key: value for key, value in loop.config["data"].items() if key in MEASURED}
    return own | {"path": [str(path) for path in paths], "time": "t", "split": {"test_fraction": 0}}


def _fit_config(loop: Loop, number: int) -> dict[str, Any]:
    """Return the fit to all episodes so far; to none, the posterior is the prior."""
    config = {key: value for key, value in loop.config.items() if key not in OWN}
    return config | {"data": _data(loop, _fitted(loop, number))}


def _fitted(loop: Loop, number: int) -> list[Path]:
    """Return the episodes before one that a fit can read."""
    rounds = [_round(loop, i) for i in range(number)]
    return [_file(loop, i) for i, facts in enumerate(rounds) if facts.get("fitted", True)]


def _recorded(loop: Loop, paths: Sequence[Path]) -> Recording:
    return read(build(_data(loop, paths), "data", default=Measurements), loop.asked.source, loop.directory, 0)


def _problem(loop: Loop, number: int, path: Path) -> str:
    """Return why a fit can make nothing of an episode that follows those before; empty: it can."""
    before = _fitted(loop, number)
    try:
        gained = len(_recorded(loop, [*before, path]).train) - len(_recorded(loop, before).train)
    except DataError as error:
        return str(error)
    stack = loop.asked.encoding.stack
    return "" if gained else f"it has fewer than {stack + 2} rows, of which one transition is made"


def _accept(loop: Loop, number: int, ride: Ride) -> None:
    """Refuse an episode of a rig that a fit could make nothing of.

    Raises:
        DataError: says why.
    """
    for i in range(number):
        before = columns_of(_file(loop, i))
        states = zip(loop.asked.encoding.states, ride.states.T, strict=True)
        if all(np.array_equal(before[q.name], column) for q, column in states):
            raise DataError(
                f"episode_{number:03d}.parquet: row by row the same as episode {i}; send the one that was driven now."
            )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"episode_{number:03d}.parquet"
        write_ride(path, ride, loop.asked.encoding, loop.asked.source.dt)
        if problem := _problem(loop, number, path):
            raise DataError(f"{path.name}: {problem}")


def _refuse_wrong_data(loop: Loop) -> None:
    """Look at the keys of the data YAML before anything is learned.

    Raises:
        ConfigError: one that does not fit the simulator.
    """
    measurements, source = build(_data(loop, []), "data", default=Measurements), loop.asked.source
    states = tuple(q.name for q in source.states)
    measurements.check_names((*states, *(q.name for q in source.inputs)), states)


def _trained(loop: Loop, number: int, model: Learned, folder: Path) -> Flown:
    """Train the policy of an episode."""
    last = _folder(loop, number - 1) if number else None
    before = last if loop.online.warm_start else None
    rival = load_policy(last / "policy")[0] if last is not None and loop.online.keep_better else None
    constants = model.study.constants | {
        "run": f"{loop.directory.name}/{number:03d}", "command": "rl-online",
        "n_train": len(model.fitted.training[0][0]),
    }  # fmt: skip
    at = done_steps(folder)
    scalars = Scalars(folder, at) if loop.settings.tensorboard else None
    with MetricStream(folder, constants, resume_at=at, scalars=scalars) as metrics:
        flown = train(
            model, loop.asked, loop.terminal, metrics, folder, label=f"policy {number}", before=before, rival=rival
        )
        metrics.close()
    saved_policies(folder, model, loop.asked, flown)
    return flown


def _surprise(loop: Loop, number: int, model: Learned) -> float:
    """Return the negative log-likelihood per transition of an episode under the model that had not seen it yet."""
    study = model.study
    try:
        recording = _recorded(loop, [_file(loop, number)])
        x, y = ev.test_arrays(transitions(recording.train, study.system.encoding.stack), study.system.encoding)
    except DataError:  # too short an episode to tell
        return float("nan")
    posterior = posteriors(study, model.fitted, model.state)[0]
    return float(np.mean(ev.one_step(posterior, x, y).nll[:, -1]))


def _facts(loop: Loop, number: int) -> dict[str, float]:
    """Return what is known of an episode, from the files."""
    table = columns_of(_file(loop, number))
    good, settled = table["good"][:-1], loop.asked.task.settled
    ended = bool(len(good) >= loop.asked.task.horizon and good[-settled:].all())
    facts: dict[str, float] = _round(loop, number)
    facts |= {"return": float(table["reward"].sum()), "steps": float(len(good))}
    return facts | ({"success": float(ended)} if loop.asked.task.success else {})


def _rows(loop: Loop) -> list[dict[str, Any]]:
    """Metric rows, one per episode and quantity; step: the episode."""
    rows = []
    for number in range(loop.online.episodes):
        for name, value in _facts(loop, number).items():
            unit = "s" if name.endswith("seconds") else "nat" if name.startswith("nll") else "1"
            base = {"seed": loop.settings.seed, "step": number, "split": "test", "output": ""}
            rows.append(base | {"metric": name, "unit": unit, "value": float(value)})
    return rows


def _constants(loop: Loop) -> dict[str, Any]:
    choices = loop.config["choices"]
    return {
        "experiment": loop.settings.name, "method": choices.get("method", ""), "sim": choices.get("sim", ""),
        "data": loop.config["world"], "run": loop.directory.name, "command": "rl-online", "n_train": None,
    }  # fmt: skip


def _publish(loop: Loop) -> None:
    """Draw the figures, write the report, and say what to type next."""
    directory, last = loop.directory, loop.online.episodes - 1
    head = (
        "episode",
        "return",
        "in the model",
        "succeeded",
        "steps",
        "NLL before it was learned",
        "fit, s",
        "policy, s",
    )
    rows = []
    for number in range(loop.online.episodes):
        f = _facts(loop, number)
        rows.append((
            str(number), f"{f['return']:.4g}", f"{f['return_in_model']:.4g}",
            ("yes" if f["success"] else "no") if loop.asked.task.success else "-", f"{f['steps']:.0f}",
            f"{f['nll_before']:.3g}", f"{f['fit_seconds']:.0f}", f"{f['policy_seconds']:.0f}",
        ))  # fmt: skip
    images = draw_online(directory) if loop.settings.figures else []
    commands = [
        f"python {typed(directory / 'policy' / 'run_policy.py')} < states.jsonl          # the last policy; no JAX needed",
        f"simpel rl-online --resume {typed(directory)} online.episodes={2 * loop.online.episodes}          # more of them",
        f"simpel evaluate {typed(_folder(loop, last) / 'posterior')} data=NAME          # the last model, on a file of yours",
    ]
    report = write_report(
        directory / "report.html",
        title=f"simpel rl-online · {loop.settings.name} · {loop.config['choices'].get('method', '')}",
        lead=f"{loop.online.episodes} episodes of {loop.asked.task.horizon} steps in {loop.config['world']}; no data before "
        "the first, whose policy was learned in the prior.",
        sections=[
            {"title": "Episodes", "head": head, "rows": rows},
            task_table(loop.asked),
            *(figure(path, f"control/{path.stem}") for path in images),
        ],
        commands=commands,
        config=dump(loop.config),
    )
    loop.terminal.line(str(report), "report")
    loop.terminal.next(commands)
