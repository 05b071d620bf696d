"""Finding what a simulator lacks: measurements, likelihood, search, verdict, next experiment; each uses those before it."""
