"""What studies of rankings share: numbers of every rollout, and what tells one ranking from another."""
