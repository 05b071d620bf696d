"""Rows as the filter takes them: cleaned columns, windows, steps of the integrator."""
