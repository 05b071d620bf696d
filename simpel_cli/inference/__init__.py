"""What every inference rule takes and gives: protocols, problem arrays, networks, predictive mixture, training loop."""
