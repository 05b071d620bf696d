"""What every search of a run shares: the simulator, clean measurements, options and time."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from simpel_cli.data import Recording
from simpel_cli.discovery.search.again import Earlier
from simpel_cli.discovery.search.budget import Budget, seconds_of
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.watch import Watch
from simpel_cli.dynamics.transition import encoding_of
from simpel_cli.filtering.measurements.cleaning import Cleaned, cleaned
from simpel_cli.filtering.setup import Key, Setup, key_of, setup
from simpel_cli.inference.noise_scale import noise_scale_of
from simpel_cli.runs.console import Terminal
from simpel_cli.studies.open import Study
from simulators.effects import Expression, Term
from simulators.model import Model


class Ground(NamedTuple):
    """What every search of a run shares.

    Args:
        model: the simulator as it was declared.
        clean: measurements without what stands out.
        options: of the search.
        declared_noise: channels whose noise the user declared.
        terminal: takes lines.
        budget: time that it may take.
        watch: is told of fits.
        wider: how often ranges of the model or of effects were found too narrow.
        earlier: what was chosen before something else was known.
        simulated: likewise by simulations.
        remembering: effects with a state of their own that the program has room for.
        places: terms that an earlier search had a place for.
        finer: whether a search asked for the integration steps of `options`, not the user.
    """

    model: Model
    clean: Cleaned
    options: Discovery
    declared_noise: tuple[str, ...]
    terminal: Terminal
    budget: Budget
    watch: Watch
    wider: int = 0
    earlier: Earlier | None = None
    simulated: Earlier | None = None
    remembering: tuple[Term, ...] = ()
    places: frozenset[Key] = frozenset()
    finer: bool = False

    def attach(self, effects: list[Expression]) -> Callable[..., Setup]:
        """Return the function of a simulator that sets a search with these effects up."""
        attached = partial(
            setup, recording=self.clean.recording, declared_noise=self.declared_noise, effects=effects,
            substeps=self.options.substeps, pairs=self.options.pairs, most_rows=self.options.rows,
        )  # fmt: skip

        def with_memory(model: Model, *, extra: Sequence[Term] = (), **more: Any) -> Setup:
            given = {key_of(t) for t in extra}
            return attached(model, extra=(*extra, *(t for t in self.remembering if key_of(t) not in given)), **more)

        return with_memory


def counted(recording: Recording, study: Study, *, spikes: bool = False) -> Recording:
    """Return measurements whose values count by the scale of their noise, where `data.noise.scale` says it."""
    source, formulas = study.system.source, dict(study.measurements.noise_scale)
    computed = set(recording.derived) - set(study.recording.estimated)
    formulas = {name: formula for name, formula in formulas.items() if name not in computed}  # no channels
    measured = [*recording.outputs, *(q.name for q in source.states)]
    unmeasured = [q.name for q in source.outputs if q.name not in measured]
    scale = noise_scale_of(formulas, encoding_of(source, recording.outputs), [*study.recording.estimated, *unmeasured])
    return recording if scale is None else scale.counted(recording, spikes=spikes)


def _alike(recording: Recording) -> Recording:
    """Return measurements that all count alike."""
    train, test = (tuple(e._replace(weight=None) for e in part) for part in (recording.train, recording.test))
    return recording._replace(train=train, test=test)


def ground_of(study: Study, effects: int, terminal: Terminal) -> Ground:
    """Clean the measurements; says what is searched in."""
    model = study.system.source
    assert isinstance(model, Model)
    options: Discovery = study.declared.groups.get("discovery") or Discovery()
    terminal.line(f"simpel discover · {model.name} · {effects} effects · {study.device}", style="bold")
    declared_noise = tuple(study.measurements.noise_std)
    clean = cleaned(counted(study.recording, study, spikes=True), model, declared_noise)
    # once more: what is typical is not what a lone value would make of it
    clean = clean._replace(recording=counted(_alike(clean.recording), study))
    bad = [c for c in clean.recording.checks if not c.ok]
    checks = len(clean.recording.checks)
    terminal.line("; ".join(f"{c.name}: {c.detail}" for c in bad) if bad else f"{checks} ok", "data")
    rows = sum(len(e.time) for e in clean.recording.train)
    if rows > options.rows:
        terminal.line(f"searching in about {options.rows} of {rows} training rows (discovery.rows)", "data")
    budget = Budget(seconds_of(options.budget))
    return Ground(model, clean, options, declared_noise, terminal, budget, Watch(budget))
