"""Physical effects that a simulator may lack. The catalogue is `conf/effect/`: one YAML each."""

from simulators.effects.expression import Expression, Scales
from simulators.effects.structure import Structure, structure
from simulators.effects.term import EffectParameter, Term
from simulators.effects.unnamed import functions_of_two, unnamed

__all__ = ["EffectParameter", "Expression", "Scales", "Structure", "Term", "functions_of_two", "structure", "unnamed"]
