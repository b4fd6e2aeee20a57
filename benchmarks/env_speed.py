"""Steps and frames a second of the environments, beside dm_control's stock camera in the same scene, and MiniWorld.

Usage: python -m benchmarks.env_speed [--names navigate-2m pebble] [--steps 500] [--rounds 5]

Every measurement runs in a process of its own (OpenGL contexts of different kinds do not mix), the variants by turns,
so that what else the machine does falls on all of them. The table shows medians, by wall time and by processor time,
which a busy machine distorts less; the ratios are of processor time. MiniWorld's OneRoom, another simulator's room with
a red box, is measured beside navigate-2m, and so is our Gymnasium adapter, which has its interface. Composer
environments and the TorchRL adapter take actions that were drawn before; TorchRL's rollout and Gymnasium's
environments draw theirs.
"""

import argparse
import importlib
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

import gymnasium
import numpy as np
import torch

import halgan_envs
from benchmarks.tables import Table, report
from halgan_envs.adapters.transition import random_action
from halgan_envs.environment import Environment
from halgan_envs.rendering.gl_backend import VARIABLE
from halgan_envs.rendering.persistent_camera import BACKEND


def bare_renderer(name: str, steps: int) -> Callable[[], None]:
    """The camera alone: no step of any environment can be faster."""
    environment = halgan_envs.named(name)(random_state=0)
    environment.reset()
    return lambda: repeat(steps, lambda: environment.task.robot.camera.render(environment.physics))


def composer(name: str, steps: int) -> Callable[[], None]:
    """Our composer environment with random actions, resets included."""
    return stepping(halgan_envs.named(name)(random_state=0), steps)


def torchrl_adapter(name: str, steps: int) -> Callable[[], None]:
    """The TorchRL environment with random actions, resets included."""
    env = halgan_envs.make(name, seed=0)
    actions = [env.action_spec.rand() for _ in range(steps)]

    def run() -> None:
        state = env.reset()
        for action in actions:
            _, state = env.step_and_maybe_reset(state.set("action", action))

    return run


def torchrl_rollout(name: str, steps: int) -> Callable[[], None]:
    """TorchRL's rollout: it draws random actions as well, and stacks all steps."""
    env = halgan_envs.make(name, seed=0)
    return lambda: env.rollout(steps, break_when_any_done=False)


def stock_camera(name: str, steps: int) -> Callable[[], None]:
    """The same task and scene with dm_control's own camera observable."""
    from dm_control.composer.observation import observable

    environment = halgan_envs.named(name)(random_state=0)
    task = environment.task
    stock = observable.MJCFCamera(task.robot.mjcf_model.find("camera", "egocentric"), height=64, width=64)
    stock.enabled = True
    task.robot.observables.add_observable("stock", stock)
    task.task_observables["pixels"].enabled = False
    return stepping(Environment(task, time_limit=20.0, random_state=0), steps)


def gymnasium_adapter(name: str, steps: int) -> Callable[[], None]:
    """The Gymnasium environment, with random actions."""
    return stepping_gymnasium(gymnasium.make(halgan_envs.gymnasium_id(name)), steps)


def miniworld(name: str, steps: int) -> Callable[[], None]:
    """MiniWorld's OneRoom, without a window, whatever the name."""
    del name
    import pyglet

    pyglet.options["headless"] = True
    gymnasium.register_envs(importlib.import_module("miniworld"))
    return stepping_gymnasium(gymnasium.make("MiniWorld-OneRoom-v0", obs_width=64, obs_height=64), steps)


TASKS = ("navigate-2m", "pick-and-place-2m", "pebble")
"""One environment of each task."""
VARIANTS = {
    "bare renderer": bare_renderer,
    "ours, composer": composer,
    "ours, TorchRL": torchrl_adapter,
    "ours, TorchRL, rollout": torchrl_rollout,
    "stock composer camera": stock_camera,
}
ALL_VARIANTS = VARIANTS | {"ours, Gymnasium": gymnasium_adapter, "MiniWorld OneRoom, Gymnasium": miniworld}
"""What navigate-2m, the room that is most like MiniWorld's, is measured with."""


def stepping(environment: Environment, steps: int) -> Callable[[], None]:
    """A run of random steps; composer resets by itself after an episode."""
    random_state = np.random.RandomState(0)
    actions = [random_action(environment.action_spec(), random_state) for _ in range(steps)]
    return lambda: [environment.step(action) for action in actions][:0]


def stepping_gymnasium(env: gymnasium.Env, steps: int) -> Callable[[], None]:
    """A run of random steps, resets included."""
    env.action_space.seed(0)
    env.reset(seed=0)

    def step() -> None:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()

    return partial(repeat, steps, step)


def repeat(times: int, what: Callable[[], object]) -> None:
    """Calls something again and again."""
    for _ in range(times):
        what()


def measure(variant: str, name: str, steps: int) -> tuple[float, float]:
    """Steps a second of one variant, of wall time and of processor time, after a warm-up of the same length."""
    torch.set_num_threads(1)
    run = ALL_VARIANTS[variant](name, steps)
    run()
    wall, processor = time.perf_counter(), time.process_time()
    run()
    return steps / (time.perf_counter() - wall), steps / (time.process_time() - processor)


def measure_elsewhere(variant: str, name: str, steps: int) -> tuple[float, float]:
    """The same in a process of its own."""
    flags = {"--names": name, "--steps": str(steps), "--variant": variant}
    command = [sys.executable, "-m", "benchmarks.env_speed", *(part for flag in flags.items() for part in flag)]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    wall, processor = output.split()[-2:]
    return float(wall), float(processor)


def main() -> None:
    """Reads the command line and prints a table, or one number for ``--variant``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--names", nargs="+", default=TASKS, choices=sorted(halgan_envs.NAMES), help="which environments"
    )
    parser.add_argument("--steps", default=500, type=int, help="steps a measurement")
    parser.add_argument("--rounds", default=5, type=int, help="measurements a variant")
    parser.add_argument("--variant", choices=ALL_VARIANTS, help="measure only this one, in the first of them, here")
    flags = parser.parse_args()
    if flags.variant:
        print(*measure(flags.variant, flags.names[0], flags.steps))
        return
    tables = []
    for name in flags.names:
        compared = ALL_VARIANTS if name == "navigate-2m" else VARIANTS
        results: dict[str, list[tuple[float, float]]] = {variant: [] for variant in compared}
        for _ in range(flags.rounds):
            for variant, values in results.items():
                values.append(measure_elsewhere(variant, name, flags.steps))
        tables.append(make_table(name, results))
    report("env_speed", tables)


def make_table(name: str, results: dict[str, list[tuple[float, float]]]) -> Table:
    """Return medians, spread, and the ratio to the stock camera."""
    wall = {variant: [value[0] for value in values] for variant, values in results.items()}
    processor = {variant: statistics.median(value[1] for value in values) for variant, values in results.items()}
    title = f"{name}, 64x64 pixels, {VARIABLE}={BACKEND}, one process"
    header = ("variant", "steps/s", "lowest to highest", "steps per processor second", "ratio to stock")
    lines = []
    for variant, values in wall.items():
        ratio = processor[variant] / processor["stock composer camera"]
        spread = f"{min(values):,.0f} to {max(values):,.0f}"
        lines.append(
            [variant, f"{statistics.median(values):,.0f}", spread, f"{processor[variant]:,.0f}", f"{ratio:.1f}"]
        )
    return Table(title, header, lines)


if __name__ == "__main__":
    main()
