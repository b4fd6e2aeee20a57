"""The loop that all agents share, evaluation, and collection beside learning."""
