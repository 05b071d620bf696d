"""Sweeps: jobs on workers, retried and resumed, collected into one table."""
