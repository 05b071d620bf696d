"""Who acts: soft actor-critic, gradient fine-tuning, planning; and roll-outs of any controller."""
