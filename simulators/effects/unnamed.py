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
from simulators.effects.term import PARAMETER, RATE, EffectParameter, Term
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
    arguments = arguments_of(model)
    for name in structure(model).dynamic:
        for argument in arguments:
            if scales.size[argument] <= 0:
                continue
            term = _of_one(
                model, scales, argument, f"unnamed_{name}", per(units[name], "s"), AMPLITUDE * scales.rate[name]
            )
            terms.append(term._replace(acts_on=name))
    if pairs and len(arguments) <= MOST_ARGUMENTS:
        terms += functions_of_two(model, scales)
    return terms


def functions_of_two(model: Model, scales: Scales, bases: int = PAIR_BASES) -> list[Term]:
    """Return one function of every two arguments of which a state is one, for every rate; `bases` waves per argument."""
    units = {q.name: q.unit for q in model.states}
    return [t for name in structure(model).dynamic for t in _pairs(name, per(units[name], "s"), model, scales, bases)]


def _pairs(name: str, unit: str, model: Model, scales: Scales, most: int) -> list[Term]:
    states, arguments = [q.name for q in model.states], arguments_of(model)
    terms: list[Term] = []
    bases = {a: waves_of(model, a)[:most] for a in arguments}
    for a, b in combinations(arguments, 2):
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
        constants = sizes_of(model, scales, (a, b))
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


def dependent(
    model: Model, scales: Scales, parameter: tuple[str, str], argument: str, unit: str, size: float, bases: int
) -> Term:
    """Return a parameter as a function of a state or an input: what that adds to it, of a standard deviation of `size`.

    Args:
        model: that has the parameter, or to which an effect brings it.
        scales: magnitudes.
        parameter: its name, and what it is called.
        argument: of the function.
        unit: of the parameter.
        size: of what is added to it.
        bases: waves of the argument.
    """
    name, label = parameter
    term = _of_one(model, scales, argument, f"unnamed_{name}", unit, size, bases)
    return term._replace(effect="dependent", acts_on=name, kind=PARAMETER, meaning=f"{label} depends on {argument}")


def arguments_of(model: Model) -> list[str]:
    """Return the states and inputs that a function may be of; which group a row is of is none."""
    slots = {i for column in slots_of(model) for i in column}
    return [*(q.name for q in model.states), *(q.name for i, q in enumerate(model.inputs) if i not in slots)]


def waves_of(model: Model, argument: str) -> list[tuple[str, float]]:
    """Return the waves of an argument with their standard deviations, as shares."""
    turns = any(q.periodic and q.name == argument for q in model.states)
    waves, shares = _harmonics(argument) if turns else _sines(argument, f"size_of_{argument}")
    return list(zip(waves, shares, strict=True))


def sizes_of(model: Model, scales: Scales, arguments: tuple[str, ...]) -> tuple[tuple[str, float], ...]:
    """Return the constants that waves of these arguments need."""
    periodic = {q.name for q in model.states if q.periodic}
    return tuple((f"size_of_{a}", scales.size[a]) for a in arguments if a not in periodic)


def _of_one(
    model: Model, scales: Scales, argument: str, prefix: str, unit: str, amplitude: float, bases: int = BASES
) -> Term:
    """Return a function of one argument that adds to a rate."""
    parameters, waves = [], []
    for j, (wave, share) in enumerate(waves_of(model, argument)[:bases], start=1):
        sd, name = amplitude * share, f"{prefix}_of_{argument}_w{j}"
        parameters.append(EffectParameter(name, f"w{j}", unit, -2 * sd, 2 * sd, 0.0, (0.0,), "normal"))
        waves.append(f"{name}*{wave}")
    return Term(
        "unnamed", "", RATE, " + ".join(waves), tuple(parameters), f"some function of {argument}", depends_on=(argument,),
        constants=sizes_of(model, scales, (argument,)),
    )  # fmt: skip


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
