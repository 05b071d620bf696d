"""The scale of the measurement noise as a declared expression of the row, `data.noise.scale`: y: 0.01 + 0.05*abs(y).

    sigma_i(row) = sigma_i s_i(row)/r_i,    r_i^2 = mean of s_i^2 over the training rows

sigma_i is learned, as it is where the noise is the same in every row, and is the noise of a typical row: only the shape of the
expression matters. A state's target is the difference of two measured values, of which each has its own noise:
s^2 = (s(row)^2 + s(next row)^2)/2.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import casadi
import jax.numpy as jnp
import numpy as np

from simpel_cli.data.recording import Episode, Recording, Transitions
from simpel_cli.dynamics.casadi_jax import to_jax_rows
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError, DataError
from simpel_cli.inference.protocols import Inference, Numbers
from simulators.expression import symbols_used
from simulators.quantity import read_term

KEY = "data.noise.scale"
LEAST = 1e-3  # of the typical scale: no value counts more than a million typical ones


class NoiseScale(NamedTuple):
    """Shape of the scale of every state's and measured output's noise; 1 of those of which nothing is said.

    Args:
        encoding: coordinates, whose names the expressions are in.
        formulas: state or output -> expression.
        function: of [states, inputs, outputs] as a column, to the scale of every state and output.
    """

    encoding: Encoding
    formulas: Mapping[str, str]
    function: casadi.Function

    @property
    def names(self) -> list[str]:
        """Names of the states and measured outputs."""
        return [q.name for q in (*self.encoding.states, *self.encoding.outputs)]

    def of_rows(self, states: Any, inputs: Any, outputs: Any) -> Any:
        """Return the scale of every state and output at rows, (n, ds + do); numpy or JAX arrays of n rows each."""
        if isinstance(states, np.ndarray):
            rows = np.concatenate([states, inputs, outputs], axis=1)
            return np.asarray(self.function.map(len(rows))(rows.T)).T if len(rows) else np.ones((0, len(self.names)))
        columns = jnp.concatenate([states, inputs, outputs.astype(states.dtype)], axis=1).T
        return to_jax_rows(self.function)(columns)[0].T

    def of_targets(self, x: Any, y: Any) -> Any:
        """Return the scale of every target where a row is predicted, (n, dy).

        The inputs of the next row are not known, unless they are linear between rows, nor are its outputs: they stay.

        Args:
            x: (n, dx) network inputs, data units.
            y: (n, dy) predicted targets, data units.
        """
        encoding = self.encoding
        states, stacked = encoding.split_x(x)
        outputs = y[:, encoding.dim_state :]
        before = self.of_rows(states, encoding.inputs_now(stacked), outputs)
        following = encoding.decode(x[:, : encoding.dim_state] + y[:, : encoding.dim_state].astype(x.dtype))
        return self._of_both(before, self.of_rows(following, encoding.input_rows(stacked)[:, -1], outputs))

    def of_ranges(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the scale of every target at points of the simulator's ranges, where nothing was measured, (n, dy).

        Raises:
            ConfigError: it is not positive there.
        """
        found: np.ndarray = self.of_targets(x, y)
        for i in self.encoding.quantity_of_target[~(np.isfinite(found) & (found > 0)).all(axis=0)]:
            formula = self.formulas[self.names[i]]
            raise ConfigError(
                f"{KEY}.{self.names[i]}: {formula} is no positive number everywhere in the ranges of the simulator. Add the "
                f"noise that is always there, e.g. 0.01 + abs({formula})."
            )
        return found

    def of_transitions(self, episodes: Sequence[Episode], pairs: Transitions) -> np.ndarray:
        """Return the scale of every target of measured transitions, of the values at both of its rows, (n, dy)."""
        if not len(pairs.row):
            return np.ones((0, self.encoding.dim_y))
        rows = [self.of_episode(episode) for episode in episodes]
        first = np.cumsum([0, *(len(own) for own in rows)])[pairs.episode]
        before = np.concatenate(rows)[first + pairs.row]
        if not self.encoding.states:
            return before
        return self._of_both(before, np.concatenate([self._at_ends(e) for e in episodes])[first + pairs.row])

    def _of_both(self, before: Any, after: Any) -> Any:
        """Return the scale of every target of its rows' scales, (n, ds + do) each."""
        xp, ds = (np if isinstance(before, np.ndarray) else jnp), len(self.encoding.states)
        change = xp.sqrt((before[:, :ds] ** 2 + after[:, :ds] ** 2) / 2)
        return xp.concatenate([change, before[:, ds:]], axis=1)[:, self.encoding.quantity_of_target]

    def of_episode(self, episode: Episode, instead: np.ndarray | None = None) -> np.ndarray:
        """Return the scale of every state and output in every row, (T, ds + do).

        Args:
            episode: measured.
            instead: (ds + du + do) of a value that is missing; None: none is.
        """
        return self._measured(episode.states, episode.inputs, episode.outputs, instead)

    def _at_ends(self, episode: Episode) -> np.ndarray:
        """Return the scales at the end of the step from every row; after the last one they stay."""
        if episode.next_states is not None:
            return self._measured(episode.next_states, episode.inputs, episode.outputs, None)
        own = self.of_episode(episode)
        return np.concatenate([own[1:], own[-1:]])

    def _measured(
        self, states: np.ndarray, inputs: np.ndarray, outputs: np.ndarray, instead: np.ndarray | None
    ) -> np.ndarray:
        turning = np.array([q.periodic for q in self.encoding.states], bool)
        states = np.where(turning, (states + np.pi) % (2 * np.pi) - np.pi, states)  # as where it is predicted
        values = np.concatenate([states, inputs, outputs], axis=1)
        if instead is not None:  # max(nan, 0) is 0 to CasADi
            values = np.where(np.isfinite(values), values, instead)
        ds, du = states.shape[1], inputs.shape[1]
        found: np.ndarray = self.of_rows(*(np.ascontiguousarray(a) for a in np.split(values, [ds, ds + du], axis=1)))
        return found

    def relative(self, x: Any, y: Any, typical: Numbers) -> Any:
        """Return the scale of every target where a row is predicted over its typical one, (n, dy).

        Args:
            x: (n, dx) network inputs, data units.
            y: (n, dy) targets, data units.
            typical: (dy,) root mean square over the training rows.
        """
        scale = self.of_targets(x, y)
        xp = np if isinstance(scale, np.ndarray) else jnp
        return xp.maximum(scale / xp.asarray(typical, scale.dtype)[None], xp.asarray(LEAST, scale.dtype))

    def refuse_wrong(self, recording: Recording, instead: np.ndarray | None = None) -> None:
        """Refuse an expression that is no scale at what was measured.

        Raises:
            DataError: with the number of rows, the first of them, and the cure.
        """
        episodes = [*recording.train, *recording.test]
        rows = [np.arange(len(e.states)) for e in episodes]
        found = [self.of_episode(e, instead) for e in episodes]
        for i, episode in enumerate(episodes):
            if episode.next_states is not None:
                rows[i], found[i] = np.tile(rows[i], 2), np.concatenate([found[i], self._at_ends(episode)])
        for name, formula in self.formulas.items():
            own = [values[:, self.names.index(name)] for values in found]
            bad = [np.unique(r[~(np.isfinite(a) & (a > 0))]) for r, a in zip(rows, own, strict=True)]
            count = sum(map(len, bad))
            if not count:
                continue
            k = next(i for i, each in enumerate(bad) if len(each))
            value = next(a for a in own[k] if not (np.isfinite(a) and a > 0))
            raise DataError(
                f"{KEY}.{name}: {formula} is no positive number in {count} of {sum(len(e.states) for e in episodes)} rows "
                f"(it is {value:.3g} in row {bad[k][0]} of episode {episodes[k].name}). Add the noise that is always there, "
                f"e.g. 0.01 + abs({formula})."
            )

    def counted(self, recording: Recording, *, spikes: bool = False) -> Recording:
        """Return measurements whose values count by the scale of their noise, `Episode.weight`; missing ones stay so.

        Of a value that an expression needs and that is missing the middle of its range is taken, of an output, which has
        none, its median.

        Args:
            recording: measured.
            spikes: whether single values may be wrong yet: a row in which an expression is no scale counts as the usual one.

        Raises:
            DataError: an expression is no scale somewhere, or with `spikes` nowhere one.
        """
        outputs = np.concatenate([e.outputs for e in recording.train])
        middles = [q.middle for q in (*self.encoding.states, *self.encoding.inputs)]
        instead = np.array([*middles, *(float(np.nanmedian(column)) for column in outputs.T)])
        usual: np.ndarray | None = None
        if spikes:
            every = np.concatenate([self.of_episode(e, instead) for e in recording.train])
            good = (np.isfinite(every) & (every > 0)).mean(axis=0) > 0.5
            usual = np.array(
                [np.median(c[np.isfinite(c) & (c > 0)]) if g else np.nan for c, g in zip(every.T, good, strict=True)]
            )
        if usual is None or np.isnan(usual).any():
            self.refuse_wrong(recording, instead)

        def of(episode: Episode) -> np.ndarray:
            found = self.of_episode(episode, instead)
            return found if usual is None else np.where(np.isfinite(found) & (found > 0), found, usual)

        known = np.concatenate([np.isfinite(np.concatenate([e.states, e.outputs], axis=1)) for e in recording.train])
        scales = np.concatenate([of(e) for e in recording.train])
        typical = np.sqrt((scales**2 * known).sum(axis=0) / np.maximum(known.sum(axis=0), 1))
        typical = np.where(typical > 0, typical, 1.0)  # of what is never measured nothing counts

        def weighed(episode: Episode) -> Episode:
            weight = np.maximum(of(episode) / typical, LEAST) ** -2
            return episode._replace(weight=weight if episode.weight is None else weight * episode.weight)

        return recording._replace(train=tuple(map(weighed, recording.train)), test=tuple(map(weighed, recording.test)))


def noise_scale_of(
    formulas: Mapping[str, Any], encoding: Encoding, unmeasured: Sequence[str] = ()
) -> NoiseScale | None:
    """Read the expressions of `data.noise.scale`; None: there are none.

    Args:
        formulas: state or output -> expression.
        encoding: coordinates.
        unmeasured: states and outputs that were not measured.

    Raises:
        ConfigError: a quantity that was not measured, or what is no expression of the simulator's quantities.
    """
    if not formulas:
        return None
    groups = (encoding.states, encoding.inputs, encoding.outputs)
    symbols = {q.name: casadi.SX.sym(q.name) for group in groups for q in group}
    terms = {}
    for name, formula in formulas.items():
        if name in unmeasured or name not in symbols:
            raise ConfigError(f"{KEY}.{name}: {name} was not measured, so that it has no noise. Leave it out.")
        try:
            for other in symbols_used(str(formula)) & set(unmeasured) - symbols.keys():
                raise ConfigError(
                    f"{KEY}.{name}: {formula} needs {other}, which was not measured. Use one of {', '.join(symbols)}."
                )
            terms[name] = read_term(f"{KEY}.{name}", formula, symbols)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    scales = [casadi.densify(terms.get(q.name, casadi.SX(1))) for q in (*encoding.states, *encoding.outputs)]
    column = casadi.vertcat(*symbols.values())
    written = {name: str(formula) for name, formula in formulas.items()}
    return NoiseScale(encoding, written, casadi.Function("scale", [column], [casadi.vertcat(*scales)]))


def with_noise_of_rows(rule: Inference, scale: NoiseScale, typical: Numbers) -> Inference:
    """Return a rule that predicts every row with the scale of its own noise.

    Args:
        rule: with the typical noise.
        scale: its shape.
        typical: (dy,) root mean square of the shape over the training rows.
    """

    def relative(x: Any, y: Any) -> Any:
        return scale.relative(x, y, typical)

    def predict(state: Any, x: Any) -> Any:
        found = rule.predict(state, x)
        return found._replace(noise_scale=found.noise_scale[None] * relative(x, found.mean).astype(found.mean.dtype))

    return rule._replace(predict=predict, typical=rule.predict, relative=relative)
