"""Worlds: simulators that answer queries, such as MuJoCo, and how they become measurements."""
