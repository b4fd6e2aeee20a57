"""Agents: the networks, loss, exploration and configuration of one algorithm a file."""
