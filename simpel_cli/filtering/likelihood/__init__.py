"""How probable measurements are under one set of effects: filter, derivatives, fit, latent force, whiteness."""
