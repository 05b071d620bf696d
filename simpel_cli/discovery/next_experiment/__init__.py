"""The next experiment: it distinguishes causes that the present measurements do not distinguish."""
