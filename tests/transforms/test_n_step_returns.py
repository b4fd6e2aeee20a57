"""n-step returns with hindsight, against a reference in plain Python."""

import random
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, MultiStepTransform
from torchrl.objectives.value import TD0Estimator

from halgan_rl.transforms import (
    DrawHindsightGoal,
    HindsightConfig,
    HindsightReward,
    StampFuturePoses,
    pipelines,
)
from tests.transforms.rows import NESTED, always, assert_identical, random_source, rename

DISTANCE, DISCOUNT, BONUS = 6, 0.9, 2.0
N_STEPS = pytest.mark.parametrize("n_steps", [2, 3, 6])


def episodes(count: int = 30, seed: int = 0) -> list[TensorDict]:
    """Random walks on a line, so that a goal may be passed more than once; each step costs something else."""
    rng = random.Random(seed)
    return [_episode(number, rng) for number in range(count)]


def _episode(number: int, rng: random.Random) -> TensorDict:
    length, solved = rng.randint(1, 15), number % 3 == 0
    places = [100 * number]
    for _ in range(length):
        places.append(places[-1] + rng.choice([-1, 0, 1, 1]))
    pose = torch.tensor([[x, -0.5 * x, 0.0] for x in places])
    reward = torch.tensor([[-rng.randint(1, 9) / 16] for _ in range(length)])
    reward[-1] += 5.0 * solved
    end = torch.arange(length)[:, None] == length - 1
    flags = {"done": end, "terminated": end & solved, "truncated": end & (not solved)}
    where = torch.tensor([[number, time] for time in range(length)])
    return TensorDict(
        {"pose": pose[:-1], "id": where, "next": {"pose": pose[1:], "reward": reward, **flags}}, batch_size=[length]
    )


def pipeline(n_steps: int, probability: float = 1.0, **options: object) -> pipelines.Hindsight:
    config = HindsightConfig(
        always(probability), max_distance=DISTANCE, nearness=1.0, success_reward=BONUS, n_steps=n_steps
    )
    return pipelines.her(rng=random_source(), config=config, discount=DISCOUNT, **options)


def read(transform: pipelines.Hindsight, stream: list[TensorDict], change: Callable = lambda rows: rows) -> TensorDict:
    """Writes episodes in pieces, then reads every row once, with hindsight."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), transform=transform)
    for piece in torch.cat(stream).split(7):
        buffer.extend(change(piece))
    return buffer[:]


def expected(row: TensorDictBase, episode: TensorDictBase, n_steps: int) -> dict[str, object]:
    """The reference: what a row should hold, given its goal."""
    time, end = row["id"][1].item(), len(episode)
    places, rewards = episode["next", "pose"][:, 0].tolist(), episode["next", "reward"].flatten().tolist()
    solved = episode["next", "terminated"].any().item()
    goal = row["goal", "pose"][0].item() if row["goal", "mask"].item() else None
    total = 0.0
    for steps in range(1, n_steps + 1):
        at = time + steps - 1
        total += DISCOUNT ** (steps - 1) * rewards[at]
        success = solved and at == end - 1
        if places[at] == goal and not success:
            total += DISCOUNT ** (steps - 1) * BONUS
            return {"reward": total, "steps": steps, "terminated": True, "truncated": False, "done": True}
        if at == end - 1:
            return {"reward": total, "steps": steps, "terminated": solved, "truncated": not solved, "done": True}
    return {"reward": total, "steps": n_steps, "terminated": False, "truncated": False, "done": False}


@N_STEPS
@pytest.mark.parametrize("probability", [0.0, 0.5, 1.0])
def test_rewards_flags_and_steps_are_those_of_the_reference(n_steps: int, probability: float) -> None:
    stream = episodes()
    rows = read(pipeline(n_steps, probability), stream)
    assert len(rows) >= sum(map(len, stream)) - DISTANCE
    within = [0] * (n_steps + 1)
    for row in rows:
        wanted = expected(row, stream[row["id"][0]], n_steps)
        assert row["next", "reward"].item() == pytest.approx(wanted["reward"], abs=1e-5)
        assert row["steps_to_next_obs"].item() == wanted["steps"]
        for name in ("terminated", "truncated", "done"):
            assert row["next", name].item() == wanted[name], name
        within[wanted["steps"]] += bool(row["goal", "mask"].item() and wanted["terminated"])
    assert all(within[1:4]) == (probability > 0)  # goals were reached at each of the first steps


@N_STEPS
def test_the_next_entries_of_a_row_are_those_after_its_last_step(n_steps: int) -> None:
    stream = episodes()
    for row in read(pipeline(n_steps), stream):
        episode, time = stream[row["id"][0]], row["id"][1].item()
        last = min(time + n_steps, len(episode)) - 1
        assert torch.equal(row["next", "pose"], episode["next", "pose"][last])


@N_STEPS
def test_the_loss_bootstraps_from_the_discount_to_the_power_of_the_steps(n_steps: int) -> None:
    rows = read(pipeline(n_steps, 0.5), episodes())
    value = TensorDictModule(lambda pose: pose[..., :1] + 3.0, in_keys=["pose"], out_keys=["state_value"])
    target = TD0Estimator(gamma=DISCOUNT, value_network=value).value_estimate(rows)
    following = (rows["next", "pose"][:, :1] + 3.0) * ~rows["next", "terminated"]
    powers = torch.tensor([DISCOUNT**steps for steps in rows["steps_to_next_obs"].flatten().tolist()])
    torch.testing.assert_close(target, rows["next", "reward"] + powers[:, None] * following)


def test_several_environments_give_the_rows_of_one_each() -> None:
    stream = [torch.cat(episodes(12, seed))[:60] for seed in (1, 2)]
    stream[1]["id"] += torch.tensor([50, 0])
    together = pipeline(3, probability=0.0)
    alone = torch.cat([read(pipeline(3, probability=0.0), [each]) for each in stream])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), transform=together)
    for piece in torch.stack(stream).split(7, dim=1):
        buffer.extend(piece)
    both = buffer[:]
    order = (1_000 * both["id"][:, 0] + both["id"][:, 1]).argsort(stable=True)
    assert_identical(both[order].exclude("index", "goal"), alone.exclude("index", "goal"))


def test_nested_keys_do_the_same() -> None:
    flat, nested = read(pipeline(3), episodes()), read(pipeline(3, keys=NESTED), episodes(), rename)
    assert_identical(nested, rename(flat))


def test_one_step_is_the_same_with_and_without_a_discount() -> None:
    config = HindsightConfig(always(1.0), max_distance=DISTANCE, nearness=1.0, success_reward=BONUS)
    plain = pipelines.her(rng=random_source(), config=config)
    assert_identical(read(pipeline(1), episodes()), read(plain, episodes()))


def in_hand(stamped: int, rewarded: int) -> pipelines.Hindsight:
    return pipelines.Hindsight(
        StampFuturePoses(DISTANCE, n_steps=stamped, discount=DISCOUNT),
        DrawHindsightGoal(always(1.0), rng=random_source()),
        HindsightReward(n_steps=rewarded, discount=DISCOUNT),
    )


@pytest.mark.parametrize(("stamped", "rewarded"), [(3, 1), (1, 3), (3, 2)])
def test_rows_that_span_other_numbers_of_steps_are_refused(stamped: int, rewarded: int) -> None:
    written = f"written by StampFuturePoses\\(n_steps={stamped}\\)" if stamped > 1 else "these are not"
    with pytest.raises(
        ValueError, match=rf"HindsightReward\(n_steps={rewarded}\) needs rows .*{written}.*same n_steps"
    ):
        read(in_hand(stamped, rewarded), episodes())


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("order", ["before", "after"])
def test_a_multi_step_transform_is_refused_on_either_side(n_steps: int, order: str) -> None:
    multi = MultiStepTransform(3, DISCOUNT)
    parts = (multi, pipeline(n_steps)) if order == "before" else (pipeline(n_steps), multi)
    with pytest.raises(ValueError, match=r"MultiStepTransform .*Remove it: .*n_steps=n, discount=g"):
        read(Compose(*parts), episodes())


@pytest.mark.parametrize("discount", [None, -0.1, 1.5])
def test_several_steps_need_the_discount_of_the_loss(discount: float | None) -> None:
    with pytest.raises(ValueError, match=f"n_steps=3 needs the discount of the loss, between 0 and 1, got {discount}"):
        HindsightReward(n_steps=3, discount=discount)


def test_no_step_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="n_steps must be at least 1, got 0"):
        HindsightReward(n_steps=0)
