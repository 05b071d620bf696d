"""What a policy drives: simulators, environments that are stepped, a rig behind a folder; and the files it takes along."""
