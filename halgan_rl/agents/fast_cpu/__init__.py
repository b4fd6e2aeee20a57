"""The same agents, computed faster on a CPU: :func:`accelerate`."""

from halgan_rl.agents.fast_cpu.acceleration import accelerate

__all__ = ["accelerate"]
