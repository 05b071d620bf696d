"""A task: what a controller is asked for, declared in YAML as expressions over states and inputs."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import casadi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from simpel_cli.dynamics.casadi_jax import checked
from simpel_cli.dynamics.encoding import Encoding
from simpel_cli.errors import ConfigError, did_you_mean
from simulators.expression import ExpressionError, parse, symbols_used
from simulators.quantity import Quantity
from simulators.sections import TERM, either, named, pair

POINTS = 512  # of the declared ranges, at which a reward is looked at
BEFORE = "_before"  # of an input's name: the command of the step before


class Judged(NamedTuple):
    """What B steps came to.

    Args:
        reward: of the step.
        good: whether the state is where it should be (`success`).
        over: whether the state ends the episode (`stop`).
    """

    reward: Float[Array, " B"]
    good: Bool[Array, " B"]
    over: Bool[Array, " B"]


class Goal(NamedTuple):
    """A task bound to the quantities of a simulator.

    Args:
        start: (key, n) -> n initial states, physical.
        judge: (next states, commands, commands before) -> what the steps came to, all physical, batched.
        uses_before: whether the commands of the step before matter.
        low, high: limits of the commands, physical.
    """

    start: Callable[[PRNGKeyArray, int], Float[Array, "n ds"]]
    judge: Callable[[Float[Array, "B ds"], Float[Array, "B du"], Float[Array, "B du"]], Judged]
    uses_before: bool
    low: tuple[float, ...]
    high: tuple[float, ...]

    def command(self, action: Float[Array, "B du"]) -> Float[Array, "B du"]:
        """Return commands in physical units of actions in [-1, 1], which are clipped to that."""
        low, high = (jnp.asarray(ends, action.dtype)[None] for ends in (self.low, self.high))
        return low + (high - low) * (jnp.clip(action, -1.0, 1.0) + 1) / 2

    @property
    def rest(self) -> tuple[float, ...]:
        """Commands that nobody gave: the nearest to nothing that is allowed."""
        return tuple(min(max(0.0, low), high) for low, high in zip(self.low, self.high, strict=True))


@dataclass(frozen=True)
class Task:
    """The `reward:` group.

    Expressions are those of a simulator's `dynamics`; they may use the states after the step (angles in [-pi, pi)), the inputs
    of the step, the inputs of the step before as `<input>_before`, and `names`.

    Args:
        reward: of one step.
        names: name -> number or expression of states, inputs and of names above it, e.g. a distance.
        initial: state -> [low, high] of a uniform initial value, {mean, std} of a normal one, or a number; left out: 0.
        horizon: steps of an episode.
        success: expression that is true where the state is as it should be; empty: there is no such thing.
        settled: last steps of an episode in which `success` has to be true.
        stop: expression that ends an episode where it is true, e.g. off the track; nothing is earned after it.
        limits: input -> [low, high] within its declared range, for a rig that must not be driven to its ends.
        noise_std: state -> standard deviation of the sensor's noise in the true world.
    """

    reward: str
    names: Mapping[str, Any] = field(default_factory=dict)
    initial: Mapping[str, Any] = field(default_factory=dict)
    horizon: int = 200
    success: str = ""
    settled: int = 10
    stop: str = ""
    limits: Mapping[str, Any] = field(default_factory=dict)
    noise_std: Mapping[str, float] = field(default_factory=dict)

    sections: ClassVar[dict[str, Any]] = {  # JSON schemas of fields whose type says too little
        "names": named(TERM),
        "initial": named(
            either(
                {"type": "number"},
                pair({"type": "number"}, "[low, high] of a uniform value."),
                {
                    "type": "object",
                    "properties": {"mean": {"type": "number"}, "std": {"type": "number", "minimum": 0}},
                    "required": ["mean", "std"],
                    "additionalProperties": False,
                },
            )
        ),
        "limits": named(pair({"type": "number"}, "[low, high] within the declared range.")),
    }

    def __post_init__(self) -> None:
        for name in ("horizon", "settled"):
            if getattr(self, name) < 1:
                raise ConfigError(f"reward.{name}: got {getattr(self, name)}; it must be at least 1.")
        for name, std in self.noise_std.items():
            if not 0 <= std < math.inf:
                raise ConfigError(f"reward.noise_std.{name}: got {std}; it must be 0 or more, and finite.")
        if self.success and self.settled > self.horizon:
            raise ConfigError(f"reward.settled: got {self.settled}; it is at most reward.horizon ({self.horizon}).")

    def bind(self, encoding: Encoding) -> Goal:
        """Return the task for a simulator's quantities.

        Raises:
            ConfigError: a name that it does not have, or an expression that cannot be read; names the key.
        """
        judge, uses_before = self._judge(encoding)
        for key, known in (("limits", encoding.inputs), ("noise_std", encoding.states), ("initial", encoding.states)):
            _known(f"reward.{key}", getattr(self, key), known)
        ends = [self._limits(q) for q in encoding.inputs]
        laws = [_law(f"reward.initial.{q.name}", self.initial.get(q.name, 0.0)) for q in encoding.states]

        def start(key: PRNGKeyArray, n: int) -> Float[Array, "n ds"]:
            keys = jax.random.split(key, max(len(laws), 1))
            return jnp.stack([law(k, n) for k, law in zip(keys, laws, strict=True)], axis=1)

        return Goal(start, judge, uses_before, tuple(low for low, _ in ends), tuple(high for _, high in ends))

    def begins(self, state: str) -> tuple[float, float]:
        """Return between which values nearly all episodes begin."""
        node = self.initial.get(state, 0.0)
        if isinstance(node, Mapping):
            return node["mean"] - 4 * node["std"], node["mean"] + 4 * node["std"]
        low, high = node if isinstance(node, list | tuple) else (node, node)
        slack = 0.1 * (high - low) + 1e-9 + 0.01 * max(abs(low), abs(high))
        return float(low - slack), float(high + slack)

    def _judge(self, encoding: Encoding) -> tuple[Callable[..., Judged], bool]:
        groups = [
            [q.name for q in encoding.states],
            [q.name for q in encoding.inputs],
            [q.name + BEFORE for q in encoding.inputs],
        ]
        vectors = [casadi.SX.sym(name, len(group)) for name, group in zip(("x", "u", "before"), groups, strict=True)]
        scope = {name: v[i] for v, group in zip(vectors, groups, strict=True) for i, name in enumerate(group)}
        used: set[str] = set()
        for name, text in self.names.items():
            if name in scope:
                raise ConfigError(f"reward.names.{name}: a state or an input is called so; choose another name.")
            scope[name] = _term(f"reward.names.{name}", text, scope)
            used |= symbols_used(str(text))
        terms = []
        for key, text in (("reward", self.reward), ("success", self.success or "0"), ("stop", self.stop or "0")):
            terms.append(_term(f"reward.{key}", text, scope))
            used |= symbols_used(str(text))
        function = casadi.Function("judge", vectors, [casadi.vertcat(*terms)])
        angles = {q.name for q in encoding.states if q.periodic}
        box = [(-math.pi, math.pi) if q.name in angles else (q.low, q.high) for q in encoding.states]
        ends = [(q.low, q.high) for q in encoding.inputs]
        _refuse_not_finite(self.reward, function, groups, [box, ends, ends])
        converted = checked(function, [box, ends, ends])

        def judge(states: Float[Array, "B ds"], commands: Float[Array, "B du"], before: Float[Array, "B du"]) -> Judged:
            values = jax.vmap(lambda x, u, b: converted(x, u, b)[0])(states, commands, before)
            return Judged(values[:, 0], values[:, 1] > 0, values[:, 2] > 0)

        return judge, bool(used & set(groups[2]))

    def _limits(self, quantity: Quantity) -> tuple[float, float]:
        ends = self.limits.get(quantity.name, (quantity.low, quantity.high))
        path = f"reward.limits.{quantity.name}"
        if not (isinstance(ends, list | tuple) and len(ends) == 2 and all(map(_finite, ends))):
            raise ConfigError(f"{path}: got {ends!r}; write [low, high].")
        if not quantity.low <= ends[0] < ends[1] <= quantity.high:
            raise ConfigError(
                f"{path}: got {list(ends)}; allowed are low < high within the declared range "
                f"[{quantity.low:g}, {quantity.high:g}]."
            )
        return float(ends[0]), float(ends[1])


def _refuse_not_finite(
    text: str, function: casadi.Function, groups: list[list[str]], boxes: list[list[tuple[float, float]]]
) -> None:
    """Refuse a reward that is no number somewhere in the declared ranges: a policy would learn to stay away from there.

    Raises:
        ConfigError: says where.
    """
    random = np.random.default_rng(0)
    points = [
        np.array([random.uniform(low, high, POINTS) for low, high in box]).reshape(len(box), POINTS) for box in boxes
    ]
    values = np.asarray(function.map(POINTS)(*points))[0]
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        where = ", ".join(
            f"{name}={column[bad[0]]:.3g}"
            for names, box in zip(groups[:2], points[:2], strict=True)
            for name, column in zip(names, box, strict=True)
        )
        raise ConfigError(
            f"reward.reward: {text!r} is {values[bad[0]]} at {where}; it must be a finite number everywhere in the declared "
            "ranges, e.g. sqrt(max(x, 0)) in place of sqrt(x)."
        )


def _term(path: str, text: Any, scope: Mapping[str, Any]) -> Any:
    try:
        return parse(str(text), scope)
    except ExpressionError as error:
        raise ConfigError(f"{path}: {error}") from None


def _known(path: str, given: Mapping[str, Any], quantities: tuple[Quantity, ...]) -> None:
    names = [q.name for q in quantities]
    for name in given:
        if name not in names:
            raise ConfigError(f"{path}.{name}: no such name; known: {', '.join(names)}.{did_you_mean(name, names)}")


def _law(path: str, node: Any) -> Callable[[PRNGKeyArray, int], Float[Array, " n"]]:
    """Return the law of an initial value."""
    if _finite(node):
        return lambda key, n: jnp.full((n,), float(node), jnp.float32)
    if isinstance(node, list | tuple) and len(node) == 2 and all(map(_finite, node)) and node[0] <= node[1]:
        low, high = float(node[0]), float(node[1])
        return lambda key, n: jax.random.uniform(key, (n,), jnp.float32, low, high)
    both = isinstance(node, Mapping) and set(node) == {"mean", "std"} and all(map(_finite, node.values()))
    if both and node["std"] >= 0:
        mean, std = float(node["mean"]), float(node["std"])
        return lambda key, n: mean + std * jax.random.normal(key, (n,), jnp.float32)
    raise ConfigError(f"{path}: got {node!r}; write a number, [low, high] or {{mean: ..., std: ...}}.")


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
