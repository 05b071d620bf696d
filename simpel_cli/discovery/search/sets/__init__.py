"""Which sets of effects are tried: one more, two at once, one in place of two, others in their place."""
