"""Files looked at for the first time: what their columns are, what is not sure, and a first data YAML that says both."""
