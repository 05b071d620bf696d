"""Continuous-discrete filter of a simulator on measured rows: measurements, likelihood, set-up, errors ahead."""
