"""An experiment: its methods, the jobs of all seeds, what was found, and how it is shown."""
