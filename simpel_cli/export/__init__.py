"""What a run learned, as files that need no simpel: networks for numpy, simulators for CasADi and C."""
