"""Simulators as CasADi models with units and ranges; the effects that they may lack; MuJoCo worlds. Needs no simpel_cli."""
