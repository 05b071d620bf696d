"""Configuration: groups and overrides are composed and launched; nodes become dataclasses. The only importer of Hydra."""
