"""A symbolic model asked like a world: one transition is `substeps` steps of the classical Runge-Kutta method."""

from dataclasses import dataclass
from functools import cached_property

import casadi
import numpy as np

from simulators.model import TIE, Flow, Model, ModelError


@dataclass(frozen=True, eq=False)
class RK4:
    """Integrator of a symbolic model, vectorised over queries.

    Args:
        model: the symbolic model.

    Raises:
        ModelError: an input has a lag, whose past is endless.

    """

    model: Model

    def __post_init__(self) -> None:
        """Refuse inputs with an endless memory: a query has a finite past."""
        for name in self.model.lag:
            raise ModelError(
                f"sim.inputs.{name}.lag: a simulator asked for single transitions cannot lag inputs; leave the lag out, or "
                "make it a state of its own"
            )

    def past(self, params: np.ndarray) -> int:
        """Return the number of inputs before its own that a transition of any of the queries (n, dp) depends on."""
        return int(np.ceil(np.max(self._delays(params), initial=0.0) / self.model.dt - TIE))

    def step(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Integrate n queries over dt: states (n, dx), inputs (n, du), params (n, dp) -> (n, dx), not wrapped.

        Raises:
            ModelError: an input has a delay; what it was before is asked for (`follow`).

        """
        for name in self.model.delay:
            raise ModelError(
                f"sim.inputs.{name}.delay: a simulator asked for single transitions cannot hold inputs back; leave the "
                "delay out, or simulate trajectories"
            )
        return self.follow(states, inputs[:, None], params)

    def follow(
        self, states: np.ndarray, history: np.ndarray, params: np.ndarray, following: np.ndarray | None = None
    ) -> np.ndarray:
        """Integrate n queries over dt, late inputs exactly: between two arrivals all are constant, or straight lines.

        Args:
            states: (n, dx).
            history: (n, past + 1, du) inputs, oldest first, each held for dt or linear to the next; the last one is given now.
                Before it the oldest was held.
            params: (n, dp).
            following: (n, du) inputs dt later, to which those go that are linear between rows; None: they stay.

        Returns:
            The states dt later, (n, dx), not wrapped.

        """
        p = np.asarray(params, float)
        rows = self._delays(p) / self.model.dt
        whole = np.floor(rows + TIE)
        part = np.clip(rows - whole, 0.0, None)  # of the transition, before the newer of two inputs arrives
        part[part < TIE] = 0.0
        edges = np.sort(np.column_stack([np.zeros(len(p)), part, np.ones(len(p))]), axis=1)
        z = np.asarray(states, float)
        if self._flow.enter is not None:
            z = _evaluate(self._flow.enter, z, p)
        newest, linear = history.shape[1] - 1, list(self.model.linear)
        known = np.concatenate([history, (history[:, -1] if following is None else following)[:, None]], axis=1)
        for k in range(edges.shape[1] - 1):
            begin, length = edges[:, k], edges[:, k + 1] - edges[:, k]
            if not length.any():
                continue
            back = np.minimum(whole + (begin[:, None] < part), newest).astype(int)
            u, after = (np.take_along_axis(known, newest + k - back[:, None, :], axis=1)[:, 0] for k in (0, 1))
            ends = []
            for time in (begin, begin + length):  # of a straight line: where it is at both ends of the piece
                passed = time[:, None] - part + (begin[:, None] < part)
                at = u.copy()
                at[:, linear] += (np.minimum(passed, 1.0) * (after - u))[:, linear]
                ends.append(at)
            z = self._along(z, ends[0], ends[1], p, length * self.model.dt)
        return z if self._flow.leave is None else _evaluate(self._flow.leave, z, p)

    def measure(self, states: np.ndarray, inputs: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Return the outputs at n points, (n, dy)."""
        return _evaluate(self._whole, states, inputs, params, result=1)

    @cached_property
    def _whole(self) -> casadi.Function:
        return self.model.function()

    @cached_property
    def _flow(self) -> Flow:
        return self.model.flow()

    def _delays(self, params: np.ndarray) -> np.ndarray:
        """Return how late every input acts in every query, s, (n, du)."""
        names = [q.name for q in self.model.params]
        late = np.zeros((len(params), len(self.model.inputs)))
        for i, q in enumerate(self.model.inputs):
            value = self.model.delay.get(q.name, 0.0)
            own = self.model.fixed.get(value, value) if isinstance(value, str) else value
            late[:, i] = params[:, names.index(own)] if isinstance(own, str) else own
        return np.maximum(late, 0.0)  # a normal prior has draws beyond its range

    def _along(
        self, z: np.ndarray, first: np.ndarray, last: np.ndarray, p: np.ndarray, duration: np.ndarray
    ) -> np.ndarray:
        """Integrate (n, dz) with inputs (n, du) on a straight line, each query for its own duration (n,), s."""
        h = (duration / self.model.substeps)[:, None]
        low, high = np.array(self._flow.low), np.array(self._flow.high)
        for step in range(self.model.substeps):
            begin, middle, end = (
                first + (step + share) / self.model.substeps * (last - first) for share in (0.0, 0.5, 1.0)
            )
            k1 = _evaluate(self._flow.rhs, z, begin, p)
            k2 = _evaluate(self._flow.rhs, z + h / 2 * k1, middle, p)
            k3 = _evaluate(self._flow.rhs, z + h / 2 * k2, middle, p)
            k4 = _evaluate(self._flow.rhs, z + h * k3, end, p)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            if self._flow.limited:
                z = np.clip(z, low, high)
        return z


def _evaluate(function: casadi.Function, *arguments: np.ndarray, result: int = 0) -> np.ndarray:
    """Evaluate a function of columns at n points, (n, rows) each."""
    found = function.map(len(arguments[0]))(*(casadi.DM(np.asarray(a, float).T) for a in arguments))
    value = found[result] if isinstance(found, (tuple, list)) else found
    rows: np.ndarray = value.full().T
    return rows
