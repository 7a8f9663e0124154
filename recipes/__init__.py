"""The experiments: scripts that read top to bottom, one YAML for each named method."""
