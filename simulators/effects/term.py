"""What an effect adds to a model: one term at one place, with its own unknown parameters."""

from typing import NamedTuple

from simulators.groups import Grouping

RATE, INPUT, SENSOR = "rate", "input", "sensor"  # adds to d(state)/dt; replaces an input; replaces a measured quantity
PARAMETER = "parameter"  # adds to a parameter of the model or of another effect
# operators on a signal, which no expression can state
DELAY, LAG, BACKLASH, SENSOR_DELAY, SENSOR_LAG = "delay", "lag", "backlash", "sensor_delay", "sensor_lag"
RATE_LIMIT = "rate_limit"  # the signal moves by one unit in so many seconds at the fastest
BETWEEN_ROWS = "between_rows"  # the way from an input that is held over one that is linear to one that is smooth
ON_INPUT = (DELAY, LAG, BACKLASH, RATE_LIMIT, BETWEEN_ROWS)
ON_SENSOR = (SENSOR_DELAY, SENSOR_LAG)
OPERATORS = (*ON_INPUT, *ON_SENSOR)
NAMED = tuple(kind for kind in OPERATORS if kind != BETWEEN_ROWS)  # that an effect may state: the other is no effect


class EffectParameter(NamedTuple):
    """One unknown parameter of an effect, in the model's units.

    At `neutral` the effect is switched off: the model is what it was without it.
    """

    name: str  # unique in the model with every effect attached
    label: str  # as the effect calls it
    unit: str
    low: float
    high: float
    neutral: float
    starts: tuple[float, ...]
    prior: str = "uniform"


class Store(NamedTuple):
    """A state that an effect brings along, which nothing measures.

    Args:
        name: unique in the model.
        unit: of it.
        low: end of its range.
        high: the other.
        rate: its rate, in the names of the model, of the parameters and its own.
        begins: quantity of the model at whose first value it begins; empty: at 0.
    """

    name: str
    unit: str
    low: float
    high: float
    rate: str
    begins: str = ""


class Term(NamedTuple):
    """One effect at one place.

    Args:
        effect: its name.
        acts_on: the state whose rate it changes, the input, the measured quantity or the parameter that it alters; of a term on
            several rates or inputs their names, separated by commas.
        kind: RATE, INPUT, SENSOR, PARAMETER or one of OPERATORS.
        expression: in the names of the model and of the parameters; empty for operators and for terms on several places. RATE
            and PARAMETER add it to the rate or the parameter; INPUT and SENSOR put it in place of the quantity.
        parameters: its parameters.
        meaning: one physical sentence.
        same_as: names of effects that no data can tell from this one.
        generalises: effects that it becomes when some of its parameters are neutral.
        dissipative: it never adds energy.
        depends_on: arguments of a function without a physical name; empty for named effects.
        constants: numbers of the expression that were read off the measurements, by name; programs take them as
            arguments, so that other measurements share what was compiled.
        groupings: how its parameters differ from group to group.
        several: of a term on several rates: (state, expression), in which `rate_STATE` is the model's own rate; of one on
            several inputs: (input, expression).
        stores: states that it brings along.
    """

    effect: str
    acts_on: str
    kind: str
    expression: str
    parameters: tuple[EffectParameter, ...]
    meaning: str
    same_as: tuple[str, ...] = ()
    generalises: tuple[str, ...] = ()
    dissipative: bool = False
    depends_on: tuple[str, ...] = ()
    constants: tuple[tuple[str, float], ...] = ()
    several: tuple[tuple[str, str], ...] = ()
    groupings: tuple[Grouping, ...] = ()
    stores: tuple[Store, ...] = ()

    @property
    def label(self) -> str:
        """Name and place, e.g. `coulomb_friction on omega`."""
        return f"{self.effect} on {self.acts_on}"

    @property
    def rates(self) -> dict[str, str]:
        """State -> what is added to its rate."""
        return (self._places if self.kind == RATE else {}) | {s.name: s.rate for s in self.stores}

    @property
    def inputs(self) -> dict[str, str]:
        """Input -> what stands in its place."""
        return self._places if self.kind == INPUT else {}

    @property
    def _places(self) -> dict[str, str]:
        return dict(self.several) or {self.acts_on: self.expression}

    @property
    def formula(self) -> str:
        """What it says, for a reader."""
        return self.expression or "; ".join(f"{s}: {e}" for s, e in self.several) or self.kind
