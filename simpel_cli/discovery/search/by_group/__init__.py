"""What differs from group to group: parameters of the simulator, effects, and how far they spread."""
