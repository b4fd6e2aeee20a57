"""Replay buffers side by side: adding 16 transitions, sampling 32 pairs of frames, bytes a transition.

Usage::

    python -m benchmarks.replay

Ours is TorchRL's ``TensorDictReplayBuffer`` on a ``FrameStorage``: plain, and with hindsight (future poses stamped when
rows are added, goals drawn and rewards rewritten when they are sampled, nothing painted: see ``update_cost`` for that).
Plain is compared with Stable-Baselines3's ``ReplayBuffer``, also with ``optimize_memory_usage`` (each frame once, but
time limits are not told from terminations), and TorchRL's own ``LazyTensorStorage``; hindsight with the HER buffers of
both, which relabel 80 % of a sample, as ours does here. The two of Stable-Baselines3 get images channels first and
transitions one by one, which is their API for one environment; the others 16 at once.

A peer and ours, at all sizes, are measured by turns on one thread. Times are medians of processor time, ratios
medians of those of each round. Samples are timed after a few that are not, for all buffers alike: the first of a
round finds cold caches, whatever the buffer, and would draw all ratios to 1. What a sample takes right after rows
were added has a column of its own, and so has one of sixteen that are drawn at once, as in our recipes
(``halgan_rl.training.loop.draw_batches``). A million rows are measured with frames of 8x8 pixels, to fit; the same
small frames show how time grows from ten thousand rows on.
"""

import dataclasses
import gc
import statistics
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl import logger as torchrl_logger
from torchrl.data import HERReplayBuffer, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose

from benchmarks import sb3_peers
from benchmarks.rounds import ratio, seconds_a_call, take_turns, warm_heap
from benchmarks.rows import EPISODE, Rows, plain
from benchmarks.tables import Table, report
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.training.loop import AT_ONCE
from halgan_rl.transforms import Annealing, DrawHindsightGoal, HindsightReward, StampFuturePoses

ADDED, PAIRS = 16, 32
UNTIMED = 5
"""Samples that go before those that are timed."""
CHUNK = 10 * EPISODE
SIZES = {64: (10_000, 100_000), 8: (10_000, 100_000, 1_000_000)}
"""Rows, by height and width of the frames [pixels]."""


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Replay buffers side by side."""

    rounds: int = 21
    """Alternating rounds; medians are reported."""
    calls: int = 25
    """Calls a round."""


@dataclasses.dataclass
class Replay:
    """A filled buffer to be measured.

    Attributes:
        rows: what to fill it with, and to go on with.
        prepare: brings rows into the form that ``add`` takes; not timed.
        add: writes what was prepared.
        sample: draws so many pairs.
        row_bytes: memory it asks for, a row [bytes].
        resident_bytes: memory that it was seen to take, a row [bytes].
    """

    rows: Rows
    prepare: Callable[[TensorDict], Any]
    add: Callable[[Any], object]
    sample: Callable[[int], object]
    row_bytes: float
    resident_bytes: float = 0.0

    def prepared(self, calls: int) -> list[Any]:
        """Return fresh rows for some calls of ``add``."""
        return [self.prepare(self.rows.take(ADDED)) for _ in range(calls)]

    def time_add(self, calls: int) -> float:
        """Return the time of adding 16 transitions [s]."""
        rows = iter(self.prepared(calls))
        return seconds_a_call(lambda: self.add(next(rows)), calls)

    def time_sample(self, calls: int) -> float:
        """Return the time of a sample [s] when others went before."""
        for _ in range(UNTIMED):
            self.sample(PAIRS)
        return seconds_a_call(partial(self.sample, PAIRS), calls)

    def time_sample_at_once(self, calls: int) -> float:
        """Return the time of a sample [s] when as many are drawn at once as our recipes draw."""
        self.sample(AT_ONCE * PAIRS)
        return seconds_a_call(partial(self.sample, AT_ONCE * PAIRS), 1 + calls // AT_ONCE) / AT_ONCE

    def time_sample_after_add(self, calls: int) -> float:
        """Return the time of the first sample after adding rows [s]."""
        seconds = 0.0
        for rows in self.prepared(calls):
            self.add(rows)
            started = time.process_time()
            self.sample(PAIRS)
            seconds += time.process_time() - started
        return seconds / calls


def chunks(rows: Rows, count: int) -> Iterable[TensorDict]:
    """Yield so many rows, some whole episodes at a time."""
    for start in range(0, count, CHUNK):
        yield rows.take(min(CHUNK, count - start))


def on_torchrl(buffer: TensorDictReplayBuffer, prepare: Callable[[TensorDict], Any], rows: Rows, count: int) -> Replay:
    """Return a filled buffer of TorchRL's."""
    add = partial(extend_and_add, buffer) if isinstance(buffer, HERReplayBuffer) else buffer.extend
    for part in chunks(rows, count):
        add(prepare(part))
    storage = buffer.storage
    own = storage.nbytes if isinstance(storage, FrameStorage) else _nbytes(storage[:])
    return Replay(rows, prepare, add, buffer.sample, own / count)


def extend_and_add(buffer: HERReplayBuffer, rows: TensorDict) -> None:
    """Write rows, the last by ``add``: in torchrl 0.14.1 sampling raises if two calls of ``extend`` went before."""
    buffer.extend(rows[:-1])
    buffer.add(rows[-1])


def _nbytes(rows: TensorDictBase) -> int:
    return sum(value.nbytes for value in rows.values(True, True))


def on_sb3(buffer: sb3_peers.ReplayBuffer, rows: Rows, count: int, *, goals: bool = False) -> Replay:
    """Return a filled buffer of Stable-Baselines3's."""
    for part in chunks(rows, count):
        sb3_peers.fill(buffer, part)
    return Replay(
        rows=rows,
        prepare=partial(sb3_peers.transitions, goals=goals),
        add=partial(sb3_peers.add, buffer),
        sample=buffer.sample,
        row_bytes=sb3_peers.nbytes(buffer) / count,
    )


def ours(rows: Rows, count: int) -> Replay:
    """Each frame once."""
    return on_torchrl(TensorDictReplayBuffer(storage=FrameStorage(count), batch_size=PAIRS), plain, rows, count)


def ours_with_hindsight(rows: Rows, count: int) -> Replay:
    """Each frame once, 32 future poses a row; 80 % of a sample relabelled."""
    draw = DrawHindsightGoal(Annealing(0.8, 0.8, 1), rng=torch.Generator().manual_seed(0))
    hindsight = Compose(StampFuturePoses(32), draw, HindsightReward())
    buffer = TensorDictReplayBuffer(storage=FrameStorage(count), batch_size=PAIRS, transform=hindsight)
    return on_torchrl(buffer, lambda part: part, rows, count)


def torchrl_plain(rows: Rows, count: int) -> Replay:
    """TorchRL's usual storage."""
    return on_torchrl(TensorDictReplayBuffer(storage=LazyTensorStorage(count), batch_size=PAIRS), plain, rows, count)


def torchrl_her(rows: Rows, count: int) -> Replay:
    """TorchRL's HER."""
    buffer = HERReplayBuffer(reached, storage=LazyTensorStorage(count), batch_size=PAIRS)
    return on_torchrl(buffer, with_goals, rows, count)


def with_goals(rows: TensorDict) -> TensorDict:
    """Return rows with poses as goals."""
    rows = rows.rename_key_("pose", "achieved_goal").rename_key_(("next", "pose"), ("next", "achieved_goal"))
    goal = torch.full_like(rows["achieved_goal"], 9.0)
    return rows.update({"desired_goal": goal, "next": {"desired_goal": goal.clone()}})


def reached(rows: TensorDictBase) -> Tensor:
    """Return 1 where the goal is reached."""
    distance = (rows["next", "achieved_goal"] - rows["desired_goal"]).norm(dim=-1, keepdim=True)
    return (distance < sb3_peers.TOLERANCE).float()


def sb3_plain(rows: Rows, count: int) -> Replay:
    """Stable-Baselines3's default."""
    return on_sb3(sb3_peers.make_buffer(count, rows.side), rows, count)


def sb3_optimized(rows: Rows, count: int) -> Replay:
    """Each frame once there too."""
    options = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    return on_sb3(sb3_peers.make_buffer(count, rows.side, **options), rows, count)


def sb3_her(rows: Rows, count: int) -> Replay:
    """Stable-Baselines3's HER."""
    return on_sb3(sb3_peers.make_her_buffer(count, rows.side), rows, count, goals=True)


LARGE = 500e6
"""Bytes; of smaller buffers the process's memory tells nothing, since what others left is used again."""
Maker = Callable[[Rows, int], Replay]
COMPARISONS: dict[tuple[str, Maker], dict[str, Maker]] = {
    ("ours", ours): {
        "SB3 ReplayBuffer": sb3_plain,
        "SB3 ReplayBuffer, optimize_memory_usage": sb3_optimized,
        "torchrl TensorDictReplayBuffer": torchrl_plain,
    },
    ("ours, hindsight", ours_with_hindsight): {"SB3 HerReplayBuffer": sb3_her, "torchrl HERReplayBuffer": torchrl_her},
}
MEASURES = {
    "add": Replay.time_add,
    "sample": Replay.time_sample,
    "after add": Replay.time_sample_after_add,
    "at once": Replay.time_sample_at_once,
}
HEADER = (
    *("frames", "rows", "buffer", "add 16 [µs]", "ours / it", "sample 32 [µs]", "ours / it"),
    *("right after an add [µs]", "ours / it", "one of 16 at once [µs]", "ours / it"),
    *("bytes a row", "of them resident", "growth of sampling, after an add"),
)


def resident() -> int:
    """Return the memory that this process has in use [bytes]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1024 * int(line.split()[1])
    raise RuntimeError("the system tells no VmRSS: run this on Linux")


def build(maker: Maker, side: int, sizes: Iterable[int]) -> dict[int, Replay]:
    """Return a buffer of each size, with what memory it takes."""
    replays = {}
    for count in sizes:
        rows = Rows(side)
        Rows(side).take(CHUNK)  # memory that passes through the heap is not the buffer's
        gc.collect()
        before = resident()
        replays[count] = maker(rows, count)
        gc.collect()
        replays[count].resident_bytes = (resident() - before) / count
    return replays


def compare(side: int, sizes: tuple[int, ...], benchmark: Benchmark) -> list[list[str]]:
    """Return the rows of the table for frames of one size."""
    gc.freeze()  # what is there to stay need not be searched at each collection
    cells = []
    for (own_name, own_maker), peers in COMPARISONS.items():
        own = build(own_maker, side, sizes)
        for position, (name, maker) in enumerate(peers.items()):
            both = {own_name: own, name: build(maker, side, sizes)}
            times = measure(both, benchmark)
            cells += [line for line in describe(side, both, times, own_name) if position == 0 or line[2] == name]
            del both
            gc.collect()
        del own
    return sorted(cells, key=lambda line: int(line[1].replace(",", "")))


Times = dict[tuple[str, str, int], list[float]]


def measure(buffers: dict[str, dict[int, Replay]], benchmark: Benchmark) -> Times:
    """Return times [s] by measure, buffer and rows, all taken by turns."""
    measures = {
        (measure, name, count): partial(timed, replay, benchmark.calls)
        for measure, timed in MEASURES.items()
        for name, replays in buffers.items()
        for count, replay in replays.items()
    }
    return take_turns(measures, benchmark.rounds)


def describe(side: int, buffers: dict[str, dict[int, Replay]], times: Times, own_name: str) -> Iterable[list[str]]:
    """Yield lines of the table."""
    for name, replays in buffers.items():
        smallest = min(replays)
        for count, replay in replays.items():
            line = [f"{side}x{side}", f"{count:,}", name]
            for measure in MEASURES:
                own, value = times[measure, own_name, count], times[measure, name, count]
                line += [f"{statistics.median(value) * 1e6:,.0f}", f"{ratio(own, value):.2f}"]
            growth = (
                ratio(times[measure, name, count], times[measure, name, smallest])
                for measure in ("sample", "after add")
            )
            taken = f"{replay.resident_bytes:,.0f}" if count * replay.row_bytes > LARGE else "-"
            line += [f"{replay.row_bytes:,.0f}", taken, " ".join(f"{g:.2f}" for g in growth)]
            yield line


def main(benchmark: Benchmark) -> None:
    """Print and save the table."""
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")
    warm_heap()
    title = (
        f"Replay, one thread, medians of {benchmark.rounds} alternating rounds of {benchmark.calls} calls, processor "
        "time. 'ours / it': below 1 ours is faster."
    )
    lines = [line for side, sizes in SIZES.items() for line in compare(side, sizes, benchmark)]
    report("replay", [Table(title, HEADER, lines)])


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
