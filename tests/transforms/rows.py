"""Rows in which nothing equals anything else by accident, and the transforms that are tried on them."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from halgan_rl.keys import Keys
from halgan_rl.transforms import (
    DrawHindsightGoal,
    HallucinateGoal,
    HindsightReward,
    ReplayTransform,
    StampFuturePoses,
)
from halgan_rl.transforms.annealing import Annealing

DISTANCE = 4
RENAMED: dict[str, NestedKey] = {
    "pixels": ("camera", "pixels"),
    "pose": ("robot", "body", "pose"),
    "reward": ("robot", "reward"),
    "done": ("robot", "done"),
    "terminated": ("robot", "terminated"),
    "truncated": ("robot", "truncated"),
    "hindsight": ("extras", "hindsight"),
    "goal": ("extras", "goal"),
}
NESTED = Keys(**RENAMED)


def invert(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """A hallucinator whose output tells which frame, pose and goal went in."""
    change = (10 * pose[..., 0] + goal_pose[..., 0]).remainder(251).to(torch.uint8)
    return 255 - pixels + change[..., None, None, None]


def invert_most(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """The same, but that it shows nothing from the poses of rows 4, 9, ..."""
    blind = pose[..., 0].round().remainder(5) == 4
    return torch.where(blind[..., None, None, None], pixels, invert(pixels, pose, goal_pose))


def sampled_rows(count: int = 12) -> TensorDict:
    """Rows ``[count]`` as the sample path meets them, each with its index in its pixels, root unlike next in every key.

    By index modulo 6: 0 unmasked, next pose at the goal; 1 masked, not at the goal; 2 masked, next pose at the goal, at
    the time limit; 3 masked, *root* pose at the goal; 4 masked, next pose at the goal; 5 unmasked, horizon 0, solved.
    """
    index = torch.arange(count)
    kind = index % 6
    ramp = index[:, None].float()
    pose = torch.cat([ramp, -0.5 * ramp, 0.01 * ramp], dim=1)
    next_pose = pose + torch.tensor([0.05, 0.02, -0.03])
    futures = next_pose[:, None] + torch.arange(DISTANCE)[:, None] * torch.tensor([0.3, 0.1, 0.02])
    goal_pose = futures[:, 2].clone()
    goal_pose[(kind == 0) | (kind == 2) | (kind == 4)] = next_pose[(kind == 0) | (kind == 2) | (kind == 4)]
    goal_pose[kind == 3] = pose[kind == 3]
    return TensorDict(
        {
            "pixels": _images(index, 1),
            "pose": pose,
            "action": torch.stack([0.1 * index, -0.1 * index], dim=1),
            "hindsight": {"pose": futures, "horizon": torch.where(kind == 5, 0, 1 + index % DISTANCE)[:, None]},
            "goal": {"mask": ((kind > 0) & (kind < 5))[:, None], "pose": goal_pose},
            "next": {
                "pixels": _images(index, 2),
                "pose": next_pose,
                "reward": -0.01 * ramp - 0.001 + (kind == 5)[:, None],
                "done": ((kind == 2) | (kind == 5))[:, None],
                "terminated": (kind == 5)[:, None],
                "truncated": (kind == 2)[:, None],
            },
        },
        batch_size=[count],
    )


def _images(index: Tensor, channel: int) -> Tensor:
    """Images ``[N, 4, 5, 3]`` (not square) with the row's index in the first channel and a mark in another."""
    images = torch.zeros(len(index), 4, 5, 3, dtype=torch.uint8)
    images[..., 0] = index[:, None, None].to(torch.uint8)
    images[:, 1, 3, channel] = 200
    return images


def stamped_by_reference(stream: TensorDictBase, distance: int) -> TensorDictBase:
    """The reference, in plain Python: all rows ``[T]`` of one environment, with their hindsight."""
    pose, next_pose = stream["pose"].tolist(), stream["next", "pose"].tolist()
    last = stream["next", "done"].flatten().tolist()
    success = (stream["next", "terminated"] | (stream["next", "reward"] > 0)).flatten().tolist()
    futures, horizons = [], []
    for start in range(len(stream)):
        poses, horizon, failing = [], 0, True
        for at in range(start, min(start + distance, len(stream))):
            failing = failing and not success[at]
            poses.append(next_pose[at])
            horizon += failing
            failing = failing and pose[at][3:] == next_pose[at][3:]
            if last[at]:
                break
        futures.append(poses + poses[-1:] * (distance - len(poses)))
        horizons.append([horizon])
    stamped = {"pose": torch.tensor(futures), "horizon": torch.tensor(horizons)}
    return stream.copy().update({"hindsight": stamped})


def rename(rows: TensorDictBase) -> TensorDictBase:
    """Moves every entry that a transform may be told of to the nested key of ``RENAMED``."""
    renamed = TensorDict(batch_size=rows.batch_size)
    for key, value in rows.items():
        if key == "next":
            renamed["next"] = rename(value)
        else:
            renamed[RENAMED.get(key, key)] = value
    return renamed


def leaves(rows: TensorDictBase) -> dict[tuple, Tensor]:
    return {key if isinstance(key, tuple) else (key,): value for key, value in rows.items(True, True)}


def assert_identical(actual: TensorDictBase, expected: TensorDictBase) -> None:
    """Same keys, dtypes and bits."""
    got, wanted = leaves(actual), leaves(expected)
    assert set(got) == set(wanted)
    for key, value in wanted.items():
        assert got[key].dtype == value.dtype, key
        assert torch.equal(got[key], value), key


def random_source(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def always(probability: float) -> Annealing:
    """A probability that stays."""
    return Annealing(probability, probability, 1)


def of_three_steps(rows: TensorDict) -> TensorDict:
    """Rows that each span three steps."""
    index = torch.arange(len(rows))[:, None]
    rows["hindsight", "reward"] = -0.25 - 0.125 * (index + torch.tensor([0, 3, 7])).remainder(5)
    return rows.set("steps_to_next_obs", torch.full((len(rows),), 3))


@dataclass(frozen=True)
class Case:
    """A transform and what the common tests must know of it."""

    make: Callable[..., ReplayTransform]
    """Builds it; takes ``keys``."""
    reads: dict[str, tuple[NestedKey, ...]]
    """Which entries each field of the keys makes it read."""
    writes: tuple[NestedKey, ...] = ()
    """Which entries it sets on the sample path."""
    on_write: bool = False
    """Whether it reads when rows are written rather than sampled."""
    prepare: Callable[[TensorDict], TensorDictBase] = TensorDict.copy
    """Makes rows that it takes out of ``sampled_rows``."""

    def apply(self, transform: ReplayTransform, rows: TensorDictBase) -> TensorDictBase:
        return transform.inv(rows) if self.on_write else transform(rows)


CASES = {
    "StampFuturePoses": Case(
        lambda **keys: StampFuturePoses(DISTANCE, **keys),
        {
            "pose": ("pose", ("next", "pose")),
            "reward": (("next", "reward"),),
            "done": (("next", "done"),),
            "terminated": (("next", "terminated"),),
        },
        on_write=True,
    ),
    "StampFuturePoses(n_steps)": Case(
        lambda **keys: StampFuturePoses(DISTANCE, n_steps=3, discount=0.5, **keys),
        {"pose": ("pose", ("next", "pose")), "reward": (("next", "reward"),), "done": (("next", "done"),)},
        on_write=True,
    ),
    "DrawHindsightGoal": Case(
        lambda **keys: DrawHindsightGoal(always(0.5), rng=random_source(), **keys),
        {"pose": ("pose",), "hindsight": (("hindsight", "pose"), ("hindsight", "horizon"))},
        (("goal", "mask"), ("goal", "pose")),
    ),
    "DrawHindsightGoal(per_slice)": Case(
        lambda **keys: DrawHindsightGoal(always(0.5), rng=random_source(), per_slice=True, **keys),
        {"pose": ("pose",), "hindsight": (("hindsight", "pose"), ("hindsight", "horizon"))},
        (("goal", "mask"), ("goal", "pose")),
    ),
    "HallucinateGoal": Case(
        lambda **keys: HallucinateGoal(invert, **keys),
        {
            "pixels": ("pixels", ("next", "pixels")),
            "pose": ("pose", ("next", "pose")),
            "goal": (("goal", "mask"), ("goal", "pose")),
        },
        ("pixels", ("next", "pixels")),
    ),
    "HallucinateGoal(seen)": Case(
        lambda **keys: HallucinateGoal(invert_most, pursue_unseen=False, **keys),
        {
            "pixels": ("pixels", ("next", "pixels")),
            "pose": ("pose", ("next", "pose")),
            "goal": (("goal", "mask"), ("goal", "pose")),
        },
        ("pixels", ("next", "pixels"), ("goal", "mask")),
    ),
    "HallucinateGoal(fixed_shape)": Case(
        lambda **keys: HallucinateGoal(invert_most, fixed_shape=True, pursue_unseen=False, **keys),
        {
            "pixels": ("pixels", ("next", "pixels")),
            "pose": ("pose", ("next", "pose")),
            "goal": (("goal", "mask"), ("goal", "pose")),
        },
        ("pixels", ("next", "pixels"), ("goal", "mask")),
    ),
    "HindsightReward": Case(
        lambda **keys: HindsightReward(**keys),
        {
            "pose": (("next", "pose"),),
            "goal": (("goal", "mask"), ("goal", "pose")),
            "reward": (("next", "reward"),),
            "done": (("next", "done"),),
            "terminated": (("next", "terminated"),),
            "truncated": (("next", "truncated"),),
        },
        (("next", "reward"), ("next", "done"), ("next", "terminated"), ("next", "truncated")),
    ),
    "HindsightReward(n_steps)": Case(
        lambda **keys: HindsightReward(n_steps=3, discount=0.5, **keys),
        {
            "goal": (("goal", "mask"), ("goal", "pose")),
            "hindsight": (("hindsight", "pose"), ("hindsight", "horizon")),
            "reward": (("next", "reward"),),
            "truncated": (("next", "truncated"),),
        },
        (*((("next", name)) for name in ("reward", "done", "terminated", "truncated")), "steps_to_next_obs"),
        prepare=of_three_steps,
    ),
    "HallucinateGoal, on writing": Case(
        lambda **keys: HallucinateGoal(invert, **keys), {"pixels": ("pixels", ("next", "pixels"))}, on_write=True
    ),
    "HindsightReward, on writing": Case(
        lambda **keys: HindsightReward(**keys),
        {name: (("next", name),) for name in ("pose", "reward", "done", "terminated", "truncated")},
        on_write=True,
    ),
}
SAMPLING = {name: case for name, case in CASES.items() if not case.on_write}
