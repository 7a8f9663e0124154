"""What alignment learns from, by which loss, and how it is watched on scenes that no loss sees."""
