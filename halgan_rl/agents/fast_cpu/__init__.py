"""The same agents, computed faster on a CPU."""
