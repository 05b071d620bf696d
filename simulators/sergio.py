"""Expression of genes in single cells: Hill kinetics of a regulatory network, described by mean and spread of every gene.

    dX_cg/dt = b_g + sum_r |K_rg| M_rg H_rg(X_cr) - lambda_g X_cg
    H_rg = u_r where K_rg > 0, else 1 - u_r,   u_r = X_cr^p/(h_r^p + X_cr^p),   h_r = mean_c X_cr

K_rg acts from regulator r on target g. Low fidelity: every gene regulates itself, p = 1. High: a random network, p = 2. The
state is (mu_g, s_g): cells lie at z = clip(mu + eps softplus(s), -3, 3) with eps the quantiles of a standard normal, in another
order for every gene, and X = X_max (z/6 + 1/2). A transition integrates the cells and tells their mean and spread.

Source: Dibaeinia and Sinha (2020, SERGIO, Cell Systems).
"""

from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Any, NamedTuple

import casadi
import numpy as np

from simulators.built import FIDELITIES
from simulators.expression import Symbol
from simulators.model import Coordinates, Model, ModelError, Quantity
from simulators.quantity import check_keys, check_word, read_number, read_range

EDGE = 3.0  # of z; the ends of the scale of expression
NARROWEST = 1e-6  # standard deviation of z
GROUPS = ("mu", "s")  # mean, and what softplus makes the spread of


class Genes(NamedTuple):
    """Constants of the genes, as symbols: a column of one row per cell, or of a single row that all cells share.

    Args:
        decay: lambda, (cells or 1, genes).
        basal: b, (cells or 1, genes).
        strength: K M, from regulator r on target g; a list over r of (cells or 1, genes). Low fidelity: only [0], the
            strength with which every gene acts on itself.

    """

    decay: Symbol
    basal: Symbol
    strength: list[Symbol]


@dataclass(frozen=True)
class Sergio:
    """Gene expression of a population of cells.

    Args:
        name: letters, digits and single underscores.
        dt: duration of one transition, in the unit of time of `decay`.
        substeps: RK4 steps per transition.
        fidelity: `low`: genes regulate themselves, linear Hill function; `high`: a random network, quadratic one.
        genes: number of genes; there are two states for each.
        cells: number of cells that stand for the population.
        x_max: expression at the upper end of the scale.
        decay: range of lambda, 1/time.
        strength: range of K, expression/time.
        basal: range of b, expression/time.
        connected: probability of an edge between two different genes, of the high fidelity.
        shared: constants belong to genes and edges; false: every cell draws its own, as published.
        range: of the states.
        gap: `mu`, `s`: expected model error of one transition.
        order_seed: of the order of the quantiles, which ties the cells of different genes together.

    Raises:
        ModelError: a value that is not allowed; names the key.

    """

    name: str
    dt: float
    substeps: int = 4
    fidelity: str = "high"
    genes: int = 10
    cells: int = 64
    x_max: float = 50.0
    decay: tuple[float, ...] = (0.4, 0.8)
    strength: tuple[float, ...] = (-5.0, 5.0)
    basal: tuple[float, ...] = (1.0, 5.0)
    connected: float = 0.5
    shared: bool = True
    range: tuple[float, ...] = (-EDGE, EDGE)
    gap: dict[str, Any] = field(default_factory=dict)
    order_seed: int = 0

    def __post_init__(self) -> None:
        """Refuse values that are not allowed."""
        check_word("sim.fidelity", self.fidelity, FIDELITIES)
        for key, least in (("genes", 1), ("cells", 2), ("substeps", 1)):
            if getattr(self, key) < least:
                raise ModelError(f"sim.{key}: {getattr(self, key)} is not allowed; give at least {least}")
        for key in ("dt", "x_max"):
            if not getattr(self, key) > 0:
                raise ModelError(f"sim.{key}: {getattr(self, key):g} is not positive")
        if not 0 <= self.connected <= 1:
            raise ModelError(f"sim.connected: {self.connected:g} is no probability; give 0 to 1")
        for key in ("decay", "strength", "basal", "range"):
            read_range(f"sim.{key}", {"range": getattr(self, key)})
        check_keys("sim.gap", self.gap, GROUPS)
        for key, value in self.gap.items():
            if read_number(f"sim.gap.{key}", value) < 0:
                raise ModelError(f"sim.gap.{key}: {value} is negative; give a standard deviation, 0 for none")

    def quantiles(self) -> np.ndarray:
        """Return eps, (cells, genes): mean 0 and variance 1 in every column, in an order of its own."""
        normal = NormalDist()
        levels = np.array([normal.inv_cdf((c + 0.5) / self.cells) for c in range(self.cells)])
        levels = (levels - levels.mean()) / levels.std()
        random = np.random.default_rng(self.order_seed)
        return np.column_stack([random.permutation(levels) for _ in range(self.genes)])

    def model(self) -> Model:
        """Return the model; matrix expressions throughout."""
        names = [f"{group}_{g + 1}" for group in GROUPS for g in range(self.genes)]
        low, high = self.range
        coordinates = Coordinates(
            self.cells * self.genes, self._enter, self._cells_rate, self._leave, (0.0, float("inf"))
        )

        def rates(x: Symbol, u: Symbol, p: Symbol) -> Symbol:
            z, q = casadi.MX.sym("z", coordinates.size), casadi.MX.sym("q", p.numel())
            pushed = casadi.Function("pushed", [z, q], [casadi.jtimes(self._leave(z, q), z, self._cells_rate(z, u, q))])
            return pushed(self._enter(x, p), p)

        return Model(
            name=self.name,
            dt=self.dt,
            substeps=self.substeps,
            states=tuple(Quantity(name, "1", low, high) for name in names),
            inputs=(),
            params=self._params(),
            outputs=(),
            rhs=rates,
            output=lambda x, u, p: casadi.MX(0, 1),
            gap={name: float(self.gap[group]) for name in names if (group := name.split("_")[0]) in self.gap},
            coordinates=coordinates,
            symbol=casadi.MX,
        )

    def _params(self) -> tuple[Quantity, ...]:
        """Return decay, basal production and strengths, then which edges there are; each block target by target."""
        numbers = [str(g + 1) for g in range(self.genes)]
        pairs = [f"{r}_{g}" for g in numbers for r in numbers] if self.fidelity == "high" else numbers
        blocks = [("lambda", "1/time", self.decay, numbers), ("b", "1/time", self.basal, numbers)]
        blocks.append(("K", "1/time", self.strength, pairs))
        params = []
        for letter, unit, (low, high), places in blocks:
            cells = [""] if self.shared else [f"_{c + 1}" for c in range(self.cells)]
            params += [Quantity(f"{letter}_{place}{cell}", unit, low, high) for place in places for cell in cells]
        if self.fidelity == "high":  # an edge is there where the number is below `connected`
            params += [Quantity(f"M_{r}_{g}", "1", 0.0, 1.0) for g in numbers for r in numbers if r != g]
        return tuple(params)

    def _constants(self, p: Symbol) -> Genes:
        rows, n = (1 if self.shared else self.cells), self.genes
        size = rows * n
        decay, basal = (_matrix(p[k * size : (k + 1) * size], rows, n) for k in (0, 1))
        if self.fidelity == "low":
            return Genes(decay, basal, [_matrix(p[2 * size : 3 * size], rows, n)])
        strength = _matrix(p[2 * size : (2 + n) * size], rows * n, n)  # column g: regulators, each with its cells
        drawn = _matrix(p[(2 + n) * size :], n - 1, n) < self.connected  # column g: regulators but g itself
        edges = casadi.horzcat(*(
            casadi.vertcat(drawn[:g, g], casadi.MX.ones(1), drawn[g:, g]) for g in range(n)
        ))  # fmt: skip
        split = casadi.vertsplit(strength, rows) if n > 1 else [strength]
        return Genes(decay, basal, [casadi.repmat(edges[r, :], rows, 1) * split[r] for r in range(n)])

    def _enter(self, x: Symbol, p: Symbol) -> Symbol:
        """Return the expression of every cell, gene by gene, from means and spreads."""
        mean, spread = (casadi.repmat(part.T, self.cells, 1) for part in casadi.vertsplit(x, self.genes))
        softplus = casadi.fmax(spread, 0) + casadi.log1p(casadi.exp(-casadi.fabs(spread)))
        z = casadi.fmin(casadi.fmax(mean + casadi.DM(self.quantiles()) * softplus, -EDGE), EDGE)
        return casadi.vec(self.x_max * (z / (2 * EDGE) + 0.5))

    def _cells_rate(self, z: Symbol, u: Symbol, p: Symbol) -> Symbol:
        return casadi.vec(rate(_matrix(z, self.cells, self.genes), self._constants(p), self.fidelity))

    def _leave(self, z: Symbol, p: Symbol) -> Symbol:
        """Return means and spreads of the cells."""
        scaled = 2 * EDGE * (_matrix(z, self.cells, self.genes) / self.x_max - 0.5)
        mean = _mean(scaled)
        variance = _mean((scaled - casadi.repmat(mean, self.cells, 1)) ** 2)
        return casadi.vertcat(mean.T, _inverse_softplus(casadi.sqrt(casadi.fmax(variance, NARROWEST**2))).T)


def rate(x: Symbol, constants: Genes, fidelity: str) -> Symbol:
    """Return dX/dt of every cell, (cells, genes), from the expression x (cells, genes).

    Args:
        x: expression.
        constants: of the genes.
        fidelity: `low`: Hill coefficient 1, self-regulation; `high`: 2, and every gene on every other.

    """
    cells, genes = x.shape

    def wide(row: Symbol) -> Symbol:
        return row if row.shape[0] == cells else casadi.repmat(row, cells, 1)

    power = x * x if fidelity == "high" else x
    middle = _mean(x)
    half = middle * middle if fidelity == "high" else middle
    hill = power / casadi.fmax(wide(half) + power, 1e-30)  # 0/0 is 0
    decay = wide(constants.basal) - wide(constants.decay) * x
    # |K| u where K > 0, |K| (1 - u) where K < 0: K u and, of inhibitors, |K|
    if fidelity == "low":
        own = constants.strength[0]
        return decay + wide(own) * hill + wide(casadi.fmax(-own, 0))
    if constants.strength[0].shape[0] == 1:
        matrix: Symbol = casadi.vertcat(*constants.strength)
        return decay + casadi.mtimes(hill, matrix) + wide(_inhibition(matrix))
    for r, strength in enumerate(constants.strength):
        decay += casadi.repmat(hill[:, r], 1, genes) * strength + casadi.fmax(-strength, 0)
    return decay


def _matrix(x: Symbol, rows: int, columns: int) -> Symbol:
    return casadi.reshape(x, rows, columns)


def _mean(x: Symbol) -> Symbol:
    """Return the mean over the rows, the cells."""
    total: Symbol = casadi.sum1(x)
    return total / x.shape[0]


def _inhibition(strength: Symbol) -> Symbol:
    """Return what inhibitors that are absent let through: the sum of |K| over those of every target."""
    return casadi.sum1(casadi.fmax(-strength, 0))


def _inverse_softplus(x: Symbol) -> Symbol:
    return x + casadi.log(-casadi.expm1(-x))
