"""What every command reads and writes: options, scenes, policies, ranked rollouts, results in parts."""
