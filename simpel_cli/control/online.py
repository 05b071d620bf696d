"""Act in the plant, measure, learn a model and a policy, act again: the work of `simpel rl-online`."""

import json
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from simpel_cli import evaluation as ev
from simpel_cli.config.compose import Job
from simpel_cli.config.resolved import dump
from simpel_cli.control.assignment import assignment, remarks
from simpel_cli.control.online_settings import MEASURED, Online
from simpel_cli.control.open_plant import open_plant
from simpel_cli.control.plants.exchange import Exchange
from simpel_cli.control.plants.plant import Plant, write_episode
from simpel_cli.control.plants.policy_files import load_policy
from simpel_cli.control.rounds import (
    OnlineRun,
    declared_fit,
    episode_facts,
    metric_constants,
    metric_rows,
    own_data,
    recorded,
    refuse_wrong_data,
    why_unusable,
)
from simpel_cli.control.saved_policies import done_steps, save_policies
from simpel_cli.control.training import TrainedPolicies, train
from simpel_cli.data import transitions
from simpel_cli.errors import ConfigError, DataError, NumericsError
from simpel_cli.runs.console import Terminal
from simpel_cli.runs.directory import make_directory
from simpel_cli.runs.files import write_text
from simpel_cli.runs.interruption import interruption, stop_if
from simpel_cli.runs.manifest import Manifest
from simpel_cli.runs.metrics import MetricStream, write_metrics
from simpel_cli.runs.settings import configure
from simpel_cli.runs.tensorboard import Scalars
from simpel_cli.studies.declared import Declared, declare, resolved
from simpel_cli.studies.fit import Learned, learned
from simpel_cli.studies.new_run import kept_run, new_run
from simpel_cli.studies.open import open_study
from simpel_cli.studies.prepare import posteriors
from simpel_cli.studies.screen import Screen

Publish = Callable[[OnlineRun], None]


def rl_online(job: Job, screen: Screen, publish: Publish) -> None:
    """Run in a new directory.

    Args:
        job: of the verb.
        screen: what a fit shows.
        publish: draws the figures and writes the report.
    """
    for word in job.given:
        group, _, key = word.partition("=")[0].lstrip("+").partition(".")
        if group == "data" and key and key.partition(".")[0] not in MEASURED:
            raise ConfigError(
                f"{word}: rl-online learns from its own episodes; of the group data it takes {', '.join(MEASURED)} only. "
                "To learn from measurements use rl-offline."
            )
    config = resolved(job)
    kind, _, rest = str(config.get("world")).partition(":")
    if kind == "folder" and rest:  # a resumed run may start elsewhere
        config["world"] = f"folder:{Path(rest).expanduser().absolute()}"
    kept = {"data": config["data"]}  # for its choice; what is built are the keys that hold for episodes
    with new_run("rl-online", config | {"data": own_data(config)}, job.directory, beside=kept) as (declared, manifest):
        _run(declared, job.directory, manifest, screen, publish)


def resume(directory: Path, screen: Screen, publish: Publish, overrides: Sequence[str] = ()) -> None:
    """Go on with an interrupted run: every step that is complete is kept, and the result is the same.

    Args:
        directory: of the run.
        screen: what a fit shows.
        publish: draws the figures and writes the report.
        overrides: `online.episodes=N` with more episodes than there were, or nothing.

    Raises:
        ConfigError: not such a run, or other overrides.
    """
    record, config, settings = kept_run("rl-online", directory)
    old = _online(declare(config, settings, only=("online",))).episodes
    episodes = _more(overrides, old)
    if episodes > old:
        config["online"] = (config.get("online") or {}) | {"episodes": episodes}
        write_text(directory / "config.yaml", dump(config))
    elif record.get("status") == "done" and _whole(directory, old):
        Terminal(settings.quiet).line(f"{directory} is complete; nothing to do.")
        return
    with Manifest(directory, "rl-online", settings) as manifest:
        _run(declare(config | {"data": own_data(config)}, settings), directory, manifest, screen, publish)


def _online(declared: Declared) -> Online:
    return declared.groups.get("online") or Online()


def _more(overrides: Sequence[str], old: int) -> int:
    """Return how many episodes a resumed run has."""
    for word in overrides:
        key, _, value = word.lstrip("+").partition("=")
        if key != "online.episodes" or not value.isdigit() or int(value) < old:
            raise ConfigError(
                f"--resume: got {word}; a resumed run keeps its configuration, except for more episodes: online.episodes=N, "
                f"N at least {old}."
            )
    return max([old, *(int(word.partition("=")[2]) for word in overrides)])


def _whole(directory: Path, episodes: int) -> bool:
    """Return whether everything is there that a finished run leaves."""
    files = [directory / "report.html", directory / "policy" / "policy.safetensors", directory / "metrics.parquet"]
    return all(
        path.exists() for path in [*files, *(directory / "episodes" / f"{i:03d}.parquet" for i in range(episodes))]
    )


def _run(declared: Declared, directory: Path, manifest: Manifest, screen: Screen, publish: Publish) -> None:
    settings = declared.settings
    if settings.seeds > 1:
        raise ConfigError(
            f"run.seeds: got {settings.seeds}; rl-online takes one seed, because its episodes follow each other. Run it "
            "once per run.seed."
        )
    manifest.facts["device"] = str(configure(settings))
    make_directory(directory / "episodes")
    asked, online = assignment(declared), _online(declared)
    terminal = Terminal(settings.quiet, directory / "run.log")
    with interruption() as interrupted:
        run = OnlineRun(declared, directory, asked, online, terminal, lambda: stop_if(interrupted))
        plant = open_plant(run)
        refuse_wrong_data(run)
        terminal.line(f"simpel rl-online · {settings.name} · seed {settings.seed}", style="bold")
        terminal.line(
            f"{online.episodes} episodes of {asked.task.horizon} steps in {run.world}"
            + (f" ({asked.truth_name})" if run.world == "sim" else ""),
            "task",
        )
        for remark in remarks(asked):
            terminal.line(remark, "warning", style="yellow")
        for number in range(online.episodes):
            _episode(run, plant, number, screen)
    # the last policy is kept: in the last model its return is at least that of the one before (online.keep_better)
    shutil.copytree(run.folder(online.episodes - 1) / "policy", directory / "policy", dirs_exist_ok=True)
    write_metrics(directory / "metrics.parquet", metric_rows(run), metric_constants(run))
    publish(run)


def _episode(run: OnlineRun, plant: Plant, number: int, screen: Screen) -> None:
    """Learn from the episodes before, act, and keep what came of it. What is complete is not done again."""
    path, folder = run.episode_file(number), run.folder(number)
    if (folder / "round.json").exists():
        if path.exists():
            return
        _withdraw(run, plant, number)
    make_directory(folder)
    began = time.perf_counter()
    try:
        study = open_study(declared_fit(run, number), run.directory)
        model = learned(study, folder / "posterior", screen, shown=False)
    except NumericsError as error:
        if not number:
            raise
        raise NumericsError(
            f"{error} The model was being fitted to {number} {'episode' if number == 1 else 'episodes'}: if a sensor failed in "
            f"the last, delete {run.episode_file(number - 1)} and go on with --resume; that episode is asked for again."
        ) from error
    fitted = time.perf_counter()
    run.check()
    trained_policies = _trained(run, number, model, folder)
    trained = time.perf_counter()
    run.check()
    if not path.exists():
        write_episode(
            path, plant.episode(number, folder / "policy"), run.asked.encoding, run.asked.source.dt, run.asked.goal.rest
        )
    problem = why_unusable(run, number, path)
    facts = {
        "return_in_model": float(trained_policies.model_returns[0]),
        "nll_before": _surprise(run, number, model),
        "broken_in_model": float(trained_policies.broken[0]),
        "fitted": not problem,
        "fit_seconds": round(fitted - began, 3),
        "policy_seconds": round(trained - fitted, 3),
        "episode_seconds": round(time.perf_counter() - trained, 3),
    }
    write_text(folder / "round.json", json.dumps(facts, indent=1))
    found = episode_facts(run, number)
    broken = (
        f"   {100 * found['broken_in_model']:.0f} % of the roll-outs in the model diverged"
        if found["broken_in_model"]
        else ""
    )
    run.terminal.line(
        f"return {found['return']:.4g} (in the model {found['return_in_model']:.4g})"
        + (f"   {'succeeded' if found['success'] else 'no success'}" if run.asked.task.success else "")
        + f"   NLL before training on it {found['nll_before']:.3g}   "
        f"fit {facts['fit_seconds']:.0f} s, policy {facts['policy_seconds']:.0f} s{broken}",
        f"episode {number}",
    )
    if problem:
        run.terminal.line(f"no model is fitted to this episode: {problem}", f"episode {number}")


def _withdraw(run: OnlineRun, plant: Plant, number: int) -> None:
    """Forget the last episode, whose file the user has deleted, and what was learned from it.

    Raises:
        ConfigError: it is not the last one.
    """
    later = [i for i in range(number + 1, run.online.episodes) if run.episode_file(i).exists()]
    if later:
        raise ConfigError(
            f"{run.episode_file(number)} is missing, but the episodes after it are there "
            f"({run.episode_file(later[0]).name}, ...), whose policies were learned from it. Put it back, or begin a new run."
        )
    run.terminal.line("its file was deleted: the results learned from it are set aside", f"episode {number}")
    (run.folder(number) / "round.json").unlink()
    for i in range(number + 1, run.online.episodes):
        folder = run.folder(i)
        if folder.exists():
            count = len(list(folder.parent.glob(f"{folder.name}.withdrawn-*"))) + 1
            folder.rename(folder.with_name(f"{folder.name}.withdrawn-{count}"))
    if isinstance(plant, Exchange):
        plant.withdraw(number)


def _trained(run: OnlineRun, number: int, model: Learned, folder: Path) -> TrainedPolicies:
    """Train the policy of an episode."""
    last = run.folder(number - 1) if number else None
    before = last if run.online.warm_start else None
    rival = load_policy(last / "policy")[0] if last is not None and run.online.keep_better else None
    constants = model.study.constants | {
        "run": f"{run.directory.name}/{number:03d}", "command": "rl-online",
        "n_train": model.fitted.n_train,
    }  # fmt: skip
    at = done_steps(folder)
    scalars = Scalars(folder, at) if run.settings.tensorboard else None
    with MetricStream(folder, constants, resume_at=at, scalars=scalars) as metrics:
        trained_policies = train(
            model, run.asked, run.terminal, metrics, folder, label=f"policy {number}", before=before, rival=rival
        )
        metrics.close()
    save_policies(folder, model, run.asked, trained_policies)
    return trained_policies


def _surprise(run: OnlineRun, number: int, model: Learned) -> float:
    """Return the negative log-likelihood per transition of an episode under the model before it is trained on it."""
    study, encoding = model.study, model.study.system.encoding
    try:
        recording = recorded(run, [run.episode_file(number)])
        x, y = ev.test_arrays(transitions(recording.train, encoding.stack, encoding.linear), encoding)
    except DataError:  # the episode is too short
        return float("nan")
    posterior = posteriors(study, model.fitted, model.state)[0]
    return float(np.mean(ev.one_step(posterior, x, y).nll[:, -1]))
