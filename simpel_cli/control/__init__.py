"""Control: tasks, worlds, agents that learn or plan in them, and the plants that they drive."""
