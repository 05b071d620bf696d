"""Predicts with a posterior that simpel fitted. Needs numpy and safetensors only; copy this file with posterior.*.

predictor = Predictor("posterior")
now = predictor.step({"phi": 3.1, "omega": 0.0}, {"u": 1.5})
now.mean, now.std                    # of the measured next state (and outputs): dicts, in the units of posterior.json
now.members                          # (L, k): what each of the L networks says, without noise
course = predictor.run({"phi": 3.1, "omega": 0.0}, commands)    # (L, T + 1, states): every network on its own predictions

Arrays do as well, rows of states and of inputs in the order of posterior.json; an input acts on past ones, too, where
`past_inputs` is not 0: then inputs are rows of (past_inputs + 1) x inputs, oldest first. Inputs that are linear between rows
(`next_inputs`) act with their next value, too, which follows in the row.
"""

import ast
import json
import operator
from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from safetensors.numpy import load_file

LEAST = 1e-3  # noise of a row over that of a typical one
FUNCTIONS: dict[str, Callable[..., float]] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "sign")},
    **{"asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2, "abs": np.abs},
    "min": lambda *terms: reduce(np.fmin, terms),
    "max": lambda *terms: reduce(np.fmax, terms),
    "where": lambda condition, a, b: a if condition != 0 else b,
}
OPERATORS: dict[type, Callable[..., float]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv, ast.Pow: operator.pow,
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq,
    ast.NotEq: operator.ne, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip


def value_of(node: ast.expr, known: dict[str, float]) -> float:
    """Return the value of an expression, of which only plain arithmetic is evaluated; known: what its names stand for."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return np.float64(value)
        case ast.Name(id=name):
            return np.float64(known[name] if name in known else {"pi": np.pi}[name])
        case ast.BinOp(left=left, op=op, right=right):
            return OPERATORS[type(op)](value_of(left, known), value_of(right, known))
        case ast.UnaryOp(op=op, operand=operand):
            return OPERATORS[type(op)](value_of(operand, known))
        case ast.Compare(left=left, ops=ops, comparators=others):
            pairs = pairwise(value_of(side, known) for side in (left, *others))
            return np.float64(all(OPERATORS[type(op)](a, b) for op, (a, b) in zip(ops, pairs, strict=True)))
        case ast.Call(func=ast.Name(id=name), args=args):
            return FUNCTIONS[name](*(value_of(argument, known) for argument in args))
    raise ValueError(f"posterior.json: noise_scale holds {ast.unparse(node)}, which is no arithmetic")


class Prediction(NamedTuple):
    """What is predicted of one step.

    Args:
        mean: by name.
        std: by name: between the networks, and of the measurement's noise; angles in rad.
        members: (L, k) next states, then outputs, of every network.
    """

    mean: dict[str, float]
    std: dict[str, float]
    members: np.ndarray


class Predictor:
    """An equal mixture of L networks with a common noise.

    Args:
        folder: with posterior.json and posterior.safetensors.
    """

    def __init__(self, folder: str | Path) -> None:
        self.facts = json.loads((Path(folder) / "posterior.json").read_text())
        arrays = load_file(Path(folder) / "posterior.safetensors")
        self.scale = {name: arrays[name].astype(float) for name in ("x_mean", "x_std", "y_mean", "y_std")}
        self.noise_std = arrays["noise_std"].astype(float)
        self.noise_rms = arrays.get("noise_rms", np.ones_like(self.noise_std)).astype(float)
        shapes = self.facts.get("noise_scale") or {}
        self.shapes = {name: ast.parse(" ".join(formula.split()), mode="eval").body for name, formula in shapes.items()}
        count = sum(name.startswith("kernel_") for name in arrays)
        self.layers = [(arrays[f"kernel_{i}"].astype(float), arrays[f"bias_{i}"].astype(float)) for i in range(count)]
        self.angle = [quantity["angle"] for quantity in self.facts["states"]]
        self.names = [quantity["name"] for group in ("states", "outputs") for quantity in self.facts[group]]

    def encode(self, states: np.ndarray) -> np.ndarray:
        """Return states (..., ds) as networks see them: an angle as its sine and cosine."""
        parts = []
        for i, angle in enumerate(self.angle):
            one = states[..., i : i + 1]
            parts += [np.sin(one), np.cos(one)] if angle else [one]
        return np.concatenate(parts, axis=-1) if parts else states

    def decode(self, encoded: np.ndarray) -> np.ndarray:
        """Return encoded states (..., k) as states (..., ds), angles between -pi and pi."""
        parts, i = [], 0
        for angle in self.angle:
            parts.append(np.arctan2(encoded[..., i], encoded[..., i + 1]) if angle else encoded[..., i])
            i += 2 if angle else 1
        return np.stack(parts, axis=-1) if parts else encoded[..., :0]

    def targets(self, x: np.ndarray) -> np.ndarray:
        """Return what every network says.

        Args:
            x: (L, n, dx) encoded states and inputs, or (n, dx), the same for all networks.

        Returns:
            (L, n, dy): changes of the encoded states, then outputs.
        """
        h = np.broadcast_to(x, (len(self.noise_members()), *x.shape[-2:]))
        h = (h - self.scale["x_mean"]) / self.scale["x_std"]
        for i, (kernel, bias) in enumerate(self.layers):
            h = h @ kernel + bias[:, None]
            if i < len(self.layers) - 1:
                h = self.activated(h)
        return h * self.scale["y_std"] + self.scale["y_mean"]

    def activated(self, h: np.ndarray) -> np.ndarray:
        """Return what a hidden layer passes on of its sums."""
        kind = self.facts.get("activation", "leaky_relu")
        if kind == "silu":
            return 0.5 * h * (1 + np.tanh(0.5 * h))
        return np.tanh(h) if kind == "tanh" else np.where(h > 0, h, self.facts["negative_slope"] * h)

    def noise_members(self) -> np.ndarray:
        """Return the last biases, one row per network."""
        return self.layers[-1][1]

    def advance(self, states: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return every network's next states (L, n, ds) and outputs (L, n, do).

        Args:
            states: (L, n, ds) or (n, ds).
            inputs: (n, (past_inputs + 1) du + next_inputs), oldest first.
        """
        encoded = self.encode(np.asarray(states, float))
        inputs = np.asarray(inputs, float)
        y = self.targets(
            np.concatenate([encoded, np.broadcast_to(inputs, (*encoded.shape[:-1], inputs.shape[-1]))], -1)
        )
        width = encoded.shape[-1]
        return self.decode(encoded + y[..., :width]), y[..., width:]

    def step(
        self,
        state: dict[str, float],
        inputs: dict[str, float],
        past: list[dict[str, float]] | None = None,
        following: dict[str, float] | None = None,
    ) -> Prediction:
        """Predict one step.

        Args:
            state: by name, in the units of posterior.json.
            inputs: that act now, by name.
            past: inputs of the steps before, oldest first; None: as now.
            following: `next_inputs` one step later; None: as now.

        Raises:
            KeyError: a name is missing.
            ValueError: a value is not finite.
        """
        s = np.array([[float(state[q["name"]]) for q in self.facts["states"]]])
        rows = [*(past if past is not None else [inputs] * self.facts["past_inputs"]), inputs]
        later = [float((following or inputs)[name]) for name in self.facts["next_inputs"]]
        u = np.array([[*(float(row[q["name"]]) for row in rows for q in self.facts["inputs"]), *later]])
        if not (np.isfinite(s).all() and np.isfinite(u).all()):
            raise ValueError(f"not finite: {state}, {inputs}")
        after, outputs = self.advance(s, u)
        members = np.concatenate([after, outputs], axis=-1)[:, 0]
        mean, spread = members.mean(axis=0), members.var(axis=0)
        noise = self._noise(s, u)
        for i, angle in enumerate(self.angle):
            if angle:  # about the mean direction
                mean[i] = np.arctan2(np.sin(members[:, i]).mean(), np.cos(members[:, i]).mean())
                spread[i] = ((np.angle(np.exp(1j * (members[:, i] - mean[i])))) ** 2).mean()
        total = np.sqrt(spread + noise**2)
        return Prediction(
            dict(zip(self.names, mean.tolist(), strict=True)),
            dict(zip(self.names, total.tolist(), strict=True)),
            members,
        )

    def run(self, state: dict[str, float], commands: list[dict[str, float]]) -> np.ndarray:
        """Let every network run on its own predictions; returns (L, T + 1, ds).

        Args:
            state: at the start.
            commands: T of them; before the first, the first was held, and after the last, the last.
        """
        s = np.array([[float(state[q["name"]]) for q in self.facts["states"]]])
        u = np.array([[float(row[q["name"]]) for q in self.facts["inputs"]] for row in commands])
        past = self.facts["past_inputs"]
        held = np.concatenate([np.repeat(u[:1], past, axis=0), u])
        names = [q["name"] for q in self.facts["inputs"]]
        later = [names.index(name) for name in self.facts["next_inputs"]]
        course = [np.broadcast_to(s, (len(self.noise_members()), *s.shape))]
        for t in range(len(u)):
            now = np.concatenate([held[t : t + past + 1].ravel(), held[min(t + past + 1, len(held) - 1)][later]])
            course.append(self.advance(course[-1], now[None])[0])
        return np.concatenate(course, axis=1)

    def relative_noise(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Return the noise of every network output in one row over that of a typical one, (dy,).

        Args:
            states: (1, ds).
            inputs: (1, (past_inputs + 1) du + next_inputs), oldest first.
        """
        if not self.shapes:
            return np.ones_like(self.noise_std)
        encoded, names = self.encode(states), [q["name"] for q in self.facts["inputs"]]
        y = self.targets(np.concatenate([encoded, inputs], axis=-1)).mean(axis=0)
        width, last = encoded.shape[-1], (self.facts["past_inputs"] + 1) * len(names)
        now = inputs[0, last - len(names) : last]
        later = now.copy()
        later[[names.index(name) for name in self.facts["next_inputs"]]] = inputs[0, last:]
        outputs, found = y[0, width:], []
        before = self._shape(states[0], now, outputs)
        after = self._shape(self.decode(encoded + y[:, :width])[0], later, outputs)
        for name, angle in zip(self.names, self.angle, strict=False):  # a change is that of two measured values
            found += [np.sqrt((before[name] ** 2 + after[name] ** 2) / 2)] * (2 if angle else 1)
        found += [before[name] for name in self.names[len(self.angle) :]]
        return np.maximum(np.array(found, float) / self.noise_rms, LEAST)

    def _shape(self, states: np.ndarray, inputs: np.ndarray, outputs: np.ndarray) -> dict[str, float]:
        """Return the declared scale of every state and output in one row; 1 where none is declared."""
        names = [q["name"] for group in ("states", "inputs", "outputs") for q in self.facts[group]]
        known = dict(zip(names, np.concatenate([states, inputs, outputs]), strict=True))
        return {name: value_of(self.shapes[name], known) if name in self.shapes else 1.0 for name in self.names}

    def _noise(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Return the noise of one measurement (ds + do,): of an angle, that across its direction."""
        std = self.noise_std * self.relative_noise(states, inputs)
        noise, i = [], 0
        for j, angle in enumerate(self.angle):
            if angle:
                sine, cosine = np.sin(states[0, j]), np.cos(states[0, j])
                noise.append(float(np.hypot(cosine * std[i], sine * std[i + 1])))
            else:
                noise.append(float(std[i]))
            i += 2 if angle else 1
        return np.array([*noise, *std[i:]])
