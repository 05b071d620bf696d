"""Estimators of the score of the prior over function values, one per file."""
