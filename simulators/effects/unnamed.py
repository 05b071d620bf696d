"""Functions without a physical name: what SimPEL's gap GP says, as hypotheses that a named effect has to beat.

    f(a) = sum_j w_j phi_j(a),    w_j ~ N(0, S(omega_j)),    phi_j the sines of a box somewhat wider than the data
    f(a, b) = sum_jk w_jk phi_j(a) phi_k(b),    w_jk ~ N(0, S(omega_j) S(omega_k)):    the product of two such kernels

Reference: Solin and Sarkka (2020), Hilbert space methods for reduced-rank Gaussian process regression, eq. 16.
"""

import math
from itertools import combinations

from numpy.polynomial import chebyshev, polynomial

from simulators.effects.expression import Scales
from simulators.effects.structure import structure
from simulators.effects.term import RATE, EffectParameter, Term
from simulators.effects.units import per
from simulators.groups import slots_of
from simulators.model import Model

BASES = 6
BOX = 1.3  # half width, in largest magnitudes of the argument
LENGTHSCALE = 0.6  # of the GP, likewise
AMPLITUDE = 0.3  # of the GP, in typical rates
PAIR_BASES = 3  # per argument of a pair
MOST_ARGUMENTS = 4  # of a model that is offered pairs: their number grows with the square, and programs with it


def unnamed(model: Model, scales: Scales, *, pairs: bool = False) -> list[Term]:
    """Return one function of each state and input, or pair of these, for every rate that something may be missing from."""
    terms = []
    units = {q.name: q.unit for q in model.states}
    periodic = {q.name for q in model.states if q.periodic}
    slots = {i for column in slots_of(model) for i in column}  # which group a row is of is no argument
    inputs = [q.name for i, q in enumerate(model.inputs) if i not in slots]
    arguments = [*(q.name for q in model.states), *inputs]
    for name in structure(model).dynamic:
        for argument in arguments:
            if scales.size[argument] <= 0:
                continue
            prefix = f"unnamed_{name}_of_{argument}_w"
            amplitude = AMPLITUDE * scales.rate[name]
            turns = argument in periodic
            size = (f"size_of_{argument}", scales.size[argument])
            waves, shares = _harmonics(argument) if turns else _sines(argument, size[0])
            parameters = tuple(
                EffectParameter(f"{prefix}{j}", f"w{j}", per(units[name], "s"), -2 * sd, 2 * sd, 0.0, (0.0,), "normal")
                for j, sd in enumerate((amplitude * share for share in shares), start=1)
            )
            text = " + ".join(f"{k.name}*{wave}" for k, wave in zip(parameters, waves, strict=True))
            meaning = f"some function of {argument}"
            constants = () if turns else (size,)
            terms.append(
                Term("unnamed", name, RATE, text, parameters, meaning, depends_on=(argument,), constants=constants)
            )
    if pairs and len(arguments) <= MOST_ARGUMENTS:
        terms += functions_of_two(model, scales)
    return terms


def functions_of_two(model: Model, scales: Scales, bases: int = PAIR_BASES) -> list[Term]:
    """Return one function of every two arguments of which a state is one, for every rate; `bases` waves per argument."""
    units = {q.name: q.unit for q in model.states}
    return [t for name in structure(model).dynamic for t in _pairs(name, per(units[name], "s"), model, scales, bases)]


def _pairs(name: str, unit: str, model: Model, scales: Scales, most: int) -> list[Term]:
    slots = {i for column in slots_of(model) for i in column}
    states, inputs = [q.name for q in model.states], [q.name for i, q in enumerate(model.inputs) if i not in slots]
    periodic = {q.name for q in model.states if q.periodic}
    terms: list[Term] = []
    bases = {}
    for a in (*states, *inputs):
        waves, shares = _harmonics(a) if a in periodic else _sines(a, f"size_of_{a}")
        bases[a] = list(zip(waves, shares, strict=True))[:most]
    for a, b in combinations((*states, *inputs), 2):
        if a not in states:
            continue
        parameters, sums = [], []
        for j, (wave, share) in enumerate(bases[a], start=1):
            row = []
            for k, (other, other_share) in enumerate(bases[b], start=1):
                label, sd = f"w{j}{k}", AMPLITUDE * scales.rate[name] * share * other_share
                parameters.append(
                    EffectParameter(
                        f"unnamed_{name}_of_{a}_{b}_{label}", label, unit, -2 * sd, 2 * sd, 0.0, (0.0,), "normal"
                    )
                )
                row.append(f"{parameters[-1].name}*{other}")
            sums.append(f"{wave}*({' + '.join(row)})")
        constants = tuple((f"size_of_{c}", scales.size[c]) for c in (a, b) if c not in periodic)
        meaning = f"some function of {a} and {b}"
        terms.append(
            Term(
                "unnamed",
                name,
                RATE,
                " + ".join(sums),
                tuple(parameters),
                meaning,
                depends_on=(a, b),
                constants=constants,
            )
        )
    return terms


def _sines(argument: str, size: str) -> tuple[list[str], list[float]]:
    """Sines of the box, in units of the argument's largest magnitude."""
    waves, shares = [], []
    for j in range(1, BASES + 1):
        frequency = math.pi * j / (2 * BOX)
        waves.append(_multiple("sin", j, f"({math.pi / (2 * BOX):.15g}*({argument}/{size} + {BOX}))"))
        density = math.sqrt(2 * math.pi) * LENGTHSCALE * math.exp(-((frequency * LENGTHSCALE) ** 2) / 2)
        shares.append(math.sqrt(density / BOX))
    return waves, shares


def _harmonics(angle: str) -> tuple[list[str], list[float]]:
    """Sines and cosines of an angle: a periodic GP."""
    waves = [_multiple(f, j, angle) for j in range(1, BASES // 2 + 1) for f in ("sin", "cos")]
    return waves, [1 / j for j in range(1, BASES // 2 + 1) for _ in range(2)]


def _multiple(wave: str, j: int, angle: str) -> str:
    """Write sin(j angle) or cos(j angle) with the sine and cosine of the angle alone, which all j then share.

    sin(j a) = sin(a) U_{j-1}(cos a),    cos(j a) = T_j(cos a)     (Chebyshev's polynomials of both kinds)
    """
    powers = chebyshev.cheb2poly([0.0] * j + [1.0])
    if wave == "sin":
        powers = polynomial.polyder(powers) / j
    degree = len(powers) - 1
    cosine = f"cos({angle})"
    square = f"({cosine}*{cosine})"
    text = f"{powers[degree]:.0f}"
    for k in range(degree - 2, -1, -2):
        text = f"({powers[k]:.0f} + {square}*{text})"
    if degree % 2:
        text = f"{cosine}*{text}"
    return text if wave == "cos" else f"sin({angle})*{text}"
