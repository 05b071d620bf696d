"""What can be wrong with measurements: each check reports, and drops, cuts or refuses where it must."""
