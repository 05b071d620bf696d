"""The experiment that distinguishes causes which the measurements cannot."""
