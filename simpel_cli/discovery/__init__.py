"""Finding what a simulator lacks: search, verdict, next experiment; each uses those before it, all of them the filter."""
