"""Checks of the measurements: each reports, and drops rows, cuts episodes or refuses the data where necessary."""
