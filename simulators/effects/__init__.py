"""Physical effects that a simulator may lack. The catalogue is `conf/effect/`: one YAML each."""

from simulators.effects.expression import Expression, Scales
from simulators.effects.stores import stores_of, with_stores
from simulators.effects.structure import Structure, structure
from simulators.effects.term import EffectParameter, Store, Term
from simulators.effects.unnamed import dependent, functions_of_two, unnamed

__all__ = [
    "EffectParameter",
    "Expression",
    "Scales",
    "Store",
    "Structure",
    "Term",
    "dependent",
    "functions_of_two",
    "stores_of",
    "structure",
    "unnamed",
    "with_stores",
]
