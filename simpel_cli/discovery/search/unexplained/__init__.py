"""What the chosen effects leave unexplained: a function of two arguments, a time-dependent disturbance."""
