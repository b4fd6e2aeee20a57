"""Updates and generators on a GPU beside the same machine's CPU. Needs no simulator and no peers.

Usage::

    python -m benchmarks.gpu

Wall time of an update by batch size (a batch lies in CPU memory, as a replay buffer gives it), with and without CUDA
graphs, and of a generator's pass. Medians of alternating rounds; the GPU is waited for. Where there is no GPU, only the
CPU is timed.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable

import torch
import tyro
from tensordict import TensorDict
from torchrl.data import Bounded

from benchmarks.tables import Table, report
from halgan_rl.agents.ddpg import DDPGConfig, make_agent
from halgan_rl.agents.fast_cpu import accelerate
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator

ACTIONS = Bounded(-1.0, 1.0, (2,))
SHAPE = (64, 64, 3)


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Updates and generators on a GPU beside the CPU."""

    rounds: int = 9
    """Alternating rounds; the median is reported."""
    calls: int = 20
    """Calls a round."""
    batch_sizes: tuple[int, ...] = (32, 128, 512)
    """Rows of a batch, and images of a generator's pass."""
    threads: int = 1
    """Threads of PyTorch on the CPU."""


def make_batch(size: int) -> TensorDict:
    """Return random rows."""
    frames = torch.randint(256, (2, size, *SHAPE)).to(torch.uint8)
    flags = {name: torch.zeros(size, 1, dtype=torch.bool) for name in ("done", "terminated")}
    after = {"pixels": frames[1], "reward": torch.zeros(size, 1), **flags}
    return TensorDict({"pixels": frames[0], "action": ACTIONS.rand((size,)), "next": after}, batch_size=[size])


def make_update(device: str, size: int, *, graphs: bool = False) -> Callable[[], object]:
    """Return an update of DDPG."""
    agent = make_agent(DDPGConfig(), action_spec=ACTIONS, image_shape=SHAPE, device=device)
    if device == "cpu":
        accelerate(agent)
    if graphs:
        agent.loss.compile(mode="reduce-overhead")
    batch = make_batch(size)
    return lambda: agent.update(batch)


def make_pass(device: str, size: int) -> Callable[[], object]:
    """Return a pass of the generator."""
    generator = CoordinateGenerator().eval().to(device)
    features = torch.randn(size, generator.encoding.size, device=device)
    latent = torch.randn(size, generator.latent_size, device=device)

    @torch.no_grad()
    def paint() -> object:
        return generator(features, latent)

    return paint


def seconds(call: Callable[[], object], calls: int) -> float:
    """Return the wall time of a call."""
    synchronize()
    started = time.perf_counter()
    for _ in range(calls):
        call()
    synchronize()
    return (time.perf_counter() - started) / calls


def synchronize() -> None:
    """Wait for the GPU, if there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def main(benchmark: Benchmark) -> None:
    """Print and save the table."""
    torch.set_num_threads(benchmark.threads)
    torch.manual_seed(0)
    calls: dict[tuple[str, int, str], Callable[[], object]] = {}
    for size in benchmark.batch_sizes:
        for device in ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]:
            calls["DDPG update", size, device] = make_update(device, size)
            calls["generator", size, device] = make_pass(device, size)
        if torch.cuda.is_available():
            calls["DDPG update", size, "cuda, graphs"] = make_update("cuda", size, graphs=True)
    for call in calls.values():
        seconds(call, 5)  # compilation, caches
    rounds = [{key: seconds(call, benchmark.calls) for key, call in calls.items()} for _ in range(benchmark.rounds)]
    lines = []
    for key in calls:
        what, size, where = key
        median = statistics.median(times[key] for times in rounds)
        ratio = statistics.median(times[what, size, "cpu"] / times[key] for times in rounds)
        lines.append([what, str(size), where, f"{1e3 * median:.2f}", f"{ratio:.2f}"])
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    title = f"Wall time on {name}, {benchmark.threads} thread(s) on the CPU, medians of {benchmark.rounds} rounds."
    report("gpu", [Table(title, ("what", "rows", "where", "ms", "times as fast as the CPU"), lines)])


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
