"""Control in a learned model: tasks, worlds, soft actor-critic, planning, policies for a rig."""
