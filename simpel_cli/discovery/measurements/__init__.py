"""What of a recording the search may use: cleaned columns, windows, steps of the integrator."""
