"""The named environments: plain functions that put robot, arena and task together."""
