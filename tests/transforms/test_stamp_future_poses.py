import itertools
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import NestedKey, TensorDict, TensorDictBase, lazy_stack
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

from halgan_rl.keys import Keys, dotted
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms import DrawHindsightGoal, StampFuturePoses
from tests.transforms.rows import always, assert_identical, random_source, stamped_by_reference

STEP, REWARDED, PICKED = "step", "rewarded", "picked"
TRUNCATED, TERMINATED, SOLVED = "truncated", "terminated", "solved"
HELD = PlanarPoses(flags=("held",))
ENDS = (TRUNCATED, TERMINATED, SOLVED)
SUCCESSES = (REWARDED, TERMINATED, SOLVED)


@dataclass
class Environment:
    """Makes rows whose poses say where they come from: (environment, episode, 0.01 · time), then a flag."""

    number: int = 0
    episode: int = 0
    time: int = 0
    count: int = 0
    held: bool = False

    def row(self, event: str) -> dict:
        """The next row; ``id`` tells it from all others."""
        pose = self.pose(self.time)
        self.held = self.held or event == PICKED
        row = {
            "id": torch.tensor([1000 * self.number + self.count]),
            "pixels": torch.full((2, 2, 3), self.count % 256, dtype=torch.uint8),
            "pose": pose,
            "next": {
                "pixels": torch.full((2, 2, 3), 255 - self.count % 256, dtype=torch.uint8),
                "pose": self.pose(self.time + 1),
                "reward": torch.tensor([1.0 if event in (REWARDED, SOLVED) else -0.5]),
                "done": torch.tensor([event in ENDS]),
                "terminated": torch.tensor([event in (TERMINATED, SOLVED)]),
                "truncated": torch.tensor([event == TRUNCATED]),
            },
        }
        self.count += 1
        self.held = self.held and event not in ENDS
        self.episode, self.time = (self.episode + 1, 0) if event in ENDS else (self.episode, self.time + 1)
        return row

    def pose(self, time: int) -> torch.Tensor:
        return torch.tensor([self.number, self.episode, 0.01 * time, self.held])


def rows(*events: str, environment: Environment | None = None) -> TensorDict:
    """Consecutive rows ``[T]`` of one environment."""
    environment = environment or Environment()
    return torch.stack([TensorDict(environment.row(event)) for event in events])


def stamping(distance: int, **options: Any) -> StampFuturePoses:
    return StampFuturePoses(distance, **{"poses": HELD, **options})


def horizons(out: TensorDictBase) -> list[int]:
    return out["hindsight", "horizon"].flatten().tolist()


def times(out: TensorDictBase) -> list[list[int]]:
    """The time, counted in steps, of each row's future poses."""
    return (out["hindsight", "pose"][..., 2] * 100).round().int().tolist()


# What is stamped


def test_each_row_learns_the_poses_after_its_own() -> None:
    out = stamping(3).inv(rows(*[STEP] * 5))
    assert times(out) == [[1, 2, 3], [2, 3, 4], [3, 4, 5]]
    assert horizons(out) == [3, 3, 3]
    assert (out["hindsight", "pose"].shape, out["hindsight", "horizon"].shape) == ((3, 3, 4), (3, 1))
    assert (out["hindsight", "pose"].dtype, out["hindsight", "horizon"].dtype) == (torch.float32, torch.int64)


def test_the_last_pose_before_the_time_limit_is_a_usable_goal() -> None:
    out = stamping(3).inv(rows(STEP, STEP, STEP, TRUNCATED))
    assert times(out) == [[1, 2, 3], [2, 3, 4], [3, 4, 4], [4, 4, 4]]
    assert horizons(out) == [3, 3, 2, 1]


@pytest.mark.parametrize("success", [TERMINATED, SOLVED])
def test_the_pose_reached_by_success_is_not_a_usable_goal(success: str) -> None:
    assert horizons(stamping(3).inv(rows(STEP, STEP, STEP, success))) == [3, 2, 1, 0]


def test_a_positive_reward_in_mid_episode_bounds_the_horizon() -> None:
    assert horizons(stamping(4).inv(rows(STEP, STEP, REWARDED, STEP, TRUNCATED))) == [2, 1, 0, 2, 1]


def test_where_flags_change_is_the_last_usable_goal_and_another_search_begins() -> None:
    out = stamping(4).inv(rows(STEP, STEP, PICKED, STEP, STEP, TRUNCATED))
    assert horizons(out) == [3, 2, 1, 3, 2, 1]
    assert out["hindsight", "pose"][0, :, 3].tolist() == [0, 0, 1, 1]


def test_termination_ends_an_episode_even_without_the_done_flag() -> None:
    stream = rows(STEP, TERMINATED, STEP, TRUNCATED)
    stream["next", "done"][1] = False
    assert times(stamping(3).inv(stream)) == [[1, 2, 2], [2, 2, 2], [1, 2, 2], [2, 2, 2]]


def test_rows_keep_everything_else_bit_for_bit() -> None:
    stream = rows(STEP, STEP, TRUNCATED, STEP, SOLVED)
    assert_identical(stamping(3).inv(stream).exclude("hindsight"), stream)


# When rows are written


def test_rows_wait_until_their_future_is_known() -> None:
    stamp, environment = stamping(3), Environment()
    assert stamp.inv(rows(STEP, environment=environment)) is None
    assert stamp.inv(rows(STEP, environment=environment)) is None
    assert stamp.inv(rows(STEP, environment=environment))["id"].flatten().tolist() == [0]
    assert stamp.inv(rows(TRUNCATED, environment=environment))["id"].flatten().tolist() == [1, 2, 3]
    assert stamp.flush() is None


def test_several_environments_are_written_one_after_the_other_each_in_order() -> None:
    stamp = stamping(2)
    first = rows(STEP, TRUNCATED, STEP, STEP, environment=Environment(0))
    second = rows(STEP, STEP, STEP, STEP, environment=Environment(1))
    assert stamp.inv(torch.stack([first, second]))["id"].flatten().tolist() == [0, 1, 2, 1000, 1001, 1002]


@st.composite
def batches(draw: st.DrawFn) -> list[TensorDict]:
    """What a collector may yield: batches ``[E, T]`` of one to three environments, which split episodes anywhere."""
    environments = [Environment(number) for number in range(draw(st.integers(1, 3)))]
    lengths = draw(st.lists(st.integers(1, 7), min_size=1, max_size=8))
    events = st.sampled_from([STEP] * 8 + [PICKED, REWARDED, TRUNCATED, TERMINATED, SOLVED])
    return [
        torch.stack([rows(*(draw(events) for _ in range(length)), environment=each) for each in environments])
        for length in lengths
    ]


@settings(max_examples=50, deadline=None)
@given(batches(), st.integers(1, 6))
def test_any_stream_in_any_batches_is_stamped_like_the_reference(batches: list[TensorDict], distance: int) -> None:
    stamp = stamping(distance)
    out = [each for each in (*map(stamp.inv, batches), stamp.flush()) if each is not None]
    stream = torch.cat(batches, dim=1)
    for environment in stream:
        mine = torch.cat([each[each["id"][:, 0] // 1000 == environment["id"][0] // 1000] for each in out])
        assert_identical(mine, stamped_by_reference(environment, distance))
    assert sum(map(len, out)) == stream.numel()


@settings(max_examples=30, deadline=None)
@given(batches(), st.integers(1, 6), st.integers(0, 20))
def test_no_goal_crosses_an_episode_also_after_the_ring_wraps(
    batches: list[TensorDict], distance: int, slack: int
) -> None:
    most = batches[0].shape[0] * (max(batch.shape[1] for batch in batches) + distance)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(most + slack), batch_size=64)
    buffer.append_transform(stamping(distance))
    buffer.append_transform(DrawHindsightGoal(always(1.0), rng=random_source(), skip_reached=False, poses=HELD))
    reference = torch.cat([stamped_by_reference(stream, distance) for stream in torch.cat(batches, dim=1)])
    for batch in batches:
        buffer.extend(batch)
        if len(buffer) == 0:
            continue
        sample = buffer.sample()
        row = reference[(reference["id"].flatten() == sample["id"]).int().argmax(1)]
        assert_identical(sample.exclude("goal", "index"), row)
        assert torch.equal(sample["goal", "mask"], row["hindsight", "horizon"] > 0)
        pose, goal = sample["pose"], sample["goal", "pose"]
        assert torch.equal(goal[:, :2], pose[:, :2]), "a goal in another environment or episode"
        assert (goal[:, 2] > pose[:, 2]).all(), "a goal that is not later than its row"


def test_a_batch_of_no_rows_changes_nothing() -> None:
    stamp, environment = stamping(3), Environment()
    stamp.inv(rows(STEP, STEP, environment=environment))
    assert stamp.inv(rows(STEP)[:0]) is None
    assert times(stamp.inv(rows(STEP, environment=environment))) == [[1, 2, 3]]


# Rows held back


def test_flush_releases_the_rows_of_the_unfinished_episode_with_what_is_known() -> None:
    stamp = stamping(4)
    assert stamp.inv(rows(STEP, STEP, REWARDED)) is None
    out = stamp.flush()
    assert times(out) == [[1, 2, 3, 3], [2, 3, 3, 3], [3, 3, 3, 3]]
    assert horizons(out) == [2, 1, 0]
    assert stamp.flush() is None


def test_flushed_rows_are_written_as_they_are() -> None:
    stamp = stamping(4)
    buffer = ReplayBuffer(storage=LazyTensorStorage(10), transform=stamp, batch_size=2)
    buffer.extend(rows(STEP, STEP))
    assert len(buffer) == 0
    buffer.extend(stamp.flush())
    assert horizons(buffer[:]) == [2, 1]


def test_after_flush_a_new_episode_may_start_in_mid_episode() -> None:
    stamp = stamping(2)
    stamp.inv(rows(STEP, STEP))
    stamp.flush()
    assert times(stamp.inv(rows(STEP, STEP, environment=Environment(episode=7)))) == [[1, 2]]


def test_after_flush_another_number_of_environments_may_write() -> None:
    stamp = stamping(2)
    stamp.inv(rows(STEP, STEP))
    stamp.flush()
    two = torch.stack([rows(STEP, STEP), rows(STEP, STEP, environment=Environment(1))])
    assert len(stamp.inv(two)) == 2


def test_rows_held_back_do_not_change_when_the_collector_reuses_its_memory() -> None:
    stamp, environment = stamping(3), Environment()
    batch = rows(STEP, STEP, environment=environment)
    kept = batch.clone()
    stamp.inv(batch)
    batch.zero_()
    out = stamp.inv(rows(STEP, TRUNCATED, environment=environment))
    assert_identical(out[:2].exclude("hindsight"), kept)


@pytest.mark.parametrize("save", ["state_dict", "dumps"])
def test_rows_held_back_survive_a_checkpoint(save: str, tmp_path: Path) -> None:
    def make() -> ReplayBuffer:
        return ReplayBuffer(storage=LazyTensorStorage(20), transform=stamping(3), batch_size=2)

    environments = [Environment(0), Environment(1)]

    def batch(*events: str) -> TensorDictBase:
        return torch.stack([rows(*events, environment=environment) for environment in environments])

    buffer = make()
    buffer.extend(batch(TRUNCATED, STEP, STEP, STEP))
    restored = make()
    if save == "state_dict":
        restored.load_state_dict(buffer.state_dict())
    else:
        buffer.dumps(tmp_path / "buffer")
        restored.loads(tmp_path / "buffer")
    rest = batch(STEP, TRUNCATED)
    for each in (buffer, restored):
        each.extend(rest)
    assert len(restored) == 12
    assert_identical(restored[:], buffer[:])


def test_a_state_dict_does_not_change_when_more_rows_come() -> None:
    stamp, environment = stamping(3), Environment()
    stamp.inv(rows(STEP, STEP, environment=environment))
    state = stamp.state_dict()
    stamp.inv(rows(STEP, TRUNCATED, environment=environment))
    restored = stamping(3)
    restored.load_state_dict(state)
    assert restored.flush()["id"].flatten().tolist() == [0, 1]


# Bad input


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize(("key", "name"), [("pose", "pose"), (("next", "pose"), r"next\.pose")])
def test_a_pose_that_is_not_finite_never_enters_the_buffer(key: object, name: str, value: float) -> None:
    stamp, environment = stamping(2), Environment()
    buffer = ReplayBuffer(storage=LazyTensorStorage(10), transform=stamp, batch_size=2)
    buffer.extend(rows(STEP, STEP, environment=environment))
    good = rows(STEP, STEP, TRUNCATED, environment=environment)
    bad = good.clone()
    bad[key][1, 2] = value
    with pytest.raises(
        ValueError, match=rf"^StampFuturePoses: the entry {name} is not finite: \[.*{value}, 0.0\]\. Mend"
    ):
        buffer.extend(bad)
    assert len(buffer) == 1
    buffer.extend(good)
    assert horizons(buffer[:]) == [2, 2, 2, 2, 1]


def test_shuffled_rows_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"^Row 1 of environment 0 starts at \[0\.0, 0\.0, 0\.02, 0\.0\], not .*consecutive"
    ):
        stamping(2).inv(rows(*[STEP] * 4)[[0, 2, 1, 3]])


def test_rows_of_several_environments_joined_in_time_are_refused() -> None:
    joined = torch.cat([rows(STEP, STEP), rows(STEP, STEP, environment=Environment(1))])
    with pytest.raises(ValueError, match=r"^Row 2 of environment 0 .*cat_results='stack'"):
        stamping(2).inv(joined)


def test_a_reset_in_mid_episode_is_refused_with_the_remedy() -> None:
    stamp = stamping(2)
    stamp.inv(rows(STEP, STEP))
    with pytest.raises(ValueError, match=r"^Row 0 of environment 0 .*extend\(transform\.flush\(\)\)"):
        stamp.inv(rows(STEP, STEP))


def test_another_number_of_environments_is_refused_with_the_remedy() -> None:
    stamp = stamping(2)
    stamp.inv(rows(STEP, STEP))
    two = torch.stack([rows(STEP), rows(STEP, environment=Environment(1))])
    with pytest.raises(ValueError, match=r"from 2 environments .* from 1\. .*flush"):
        stamp.inv(two)


def test_a_row_written_by_add_is_refused_with_the_remedy() -> None:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), transform=stamping(2), batch_size=2)
    with pytest.raises(ValueError, match=r"extend\(row\.unsqueeze\(0\)\)"):
        buffer.add(rows(STEP)[0])


def test_a_batch_with_other_entries_than_the_rows_held_back_is_refused_and_forgotten() -> None:
    stamp, environment = stamping(4), Environment()
    stamp.inv(rows(STEP, STEP, environment=environment))
    rest = rows(STEP, TRUNCATED, environment=environment)
    flat = rest.clone().set("id", rest["id"].float())
    more = rest.clone().exclude("id").set("extra", torch.zeros(2)).set(("next", "more"), torch.zeros(2))
    with pytest.raises(KeyError, match=r"have extra, next\.more and lack id, unlike those before.*held back"):
        stamp.inv(more)
    with pytest.raises(ValueError, match=r"id is torch\.float32 \(1,\), in those before .* torch\.int64 \(1,\)"):
        stamp.inv(flat)
    with pytest.raises(ValueError, match=r"pixels is torch\.uint8 \(2, 3\), .* \(2, 2, 3\)"):
        stamp.inv(rest.clone().set("pixels", rest["pixels"][:, 0]))
    assert stamp.inv(rest)["id"].flatten().tolist() == [0, 1, 2, 3]


def test_a_write_can_be_taken_back_once() -> None:
    stamp, environment = stamping(3), Environment()
    stamp.inv(rows(STEP, STEP, environment=environment))
    batch = rows(STEP, STEP, environment=environment)
    assert len(stamp.inv(batch)) == 2
    for _ in range(2):
        stamp.undo_write()
    assert stamp.inv(batch)["id"].flatten().tolist() == [0, 1]


def test_a_batch_of_nothing_cannot_take_the_last_write_back() -> None:
    stamp = stamping(3)
    stamp.inv(rows(STEP, STEP))
    stamp.inv(rows(STEP)[:0])
    stamp.undo_write()
    assert len(stamp.flush()) == 2


def test_rows_of_another_max_distance_are_refused() -> None:
    stamped = stamping(3).inv(rows(STEP, TRUNCATED))
    with pytest.raises(ValueError, match=r"hold 3 future poses each \(hindsight\.pose\).*max_distance=4"):
        stamping(4).inv(stamped)


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize(("name", "other"), [("max_distance", {}), ("n_steps", {"n_steps": 2, "discount": 0.9})])
def test_a_checkpoint_of_another_kind_is_refused(held: bool, name: str, other: dict, tmp_path: Path) -> None:
    def buffer(distance: int, **options: Any) -> ReplayBuffer:
        return ReplayBuffer(storage=LazyTensorStorage(20), transform=stamping(distance, **options), batch_size=2)

    saved = buffer(3)
    saved.extend(rows(STEP, TRUNCATED, *[STEP] * held))
    saved.dumps(tmp_path)
    restored = buffer(3 if other else 5, **other)
    with pytest.raises(ValueError, match=rf"written with {name}=\d, this transform has {name}=\d.*build it with"):
        restored.loads(tmp_path)
    with pytest.raises(ValueError, match=rf"written with {name}=\d"):
        restored.load_state_dict(saved.state_dict())


# What a success is


def with_bonus(stream: TensorDictBase) -> TensorDictBase:
    """An alive bonus of 0.01 a step."""
    reward = stream["next", "reward"]
    return stream.clone().set(("next", "reward"), torch.where(reward > 0, reward, 0.01))


def test_below_the_threshold_a_reward_is_no_success() -> None:
    stream = with_bonus(rows(STEP, STEP, REWARDED, STEP, TRUNCATED))
    assert horizons(stamping(4).inv(stream)) == [0, 0, 0, 0, 0]
    assert horizons(stamping(4, success_threshold=0.5).inv(stream)) == [2, 1, 0, 2, 1]


@pytest.mark.parametrize("key", ["won", ("task", "won")])
def test_a_flag_may_say_what_a_success_is(key: NestedKey) -> None:
    keys = Keys(success=key)
    stream = with_bonus(rows(STEP, STEP, REWARDED, STEP, STEP, TERMINATED))
    won = torch.tensor([0, 1, 0, 0, 0, 0], dtype=torch.bool)[:, None]
    stream.set(keys.next("success"), won).set(key, ~won)
    assert horizons(stamping(4, keys=keys).inv(stream)) == [1, 0, 3, 2, 1, 0]


def test_a_flag_of_success_that_is_missing_or_no_flag_is_refused() -> None:
    stamp = stamping(4, keys=Keys(success="won"))
    with pytest.raises(KeyError, match=r"misses the key next\.won, set by keys=Keys\(success='won'\)"):
        stamp.inv(rows(STEP, STEP))
    with pytest.raises(ValueError, match=r"next\.won is torch\.float32 \(1, 2, 1\), but a success is one bool"):
        stamp.inv(rows(STEP, STEP).set(("next", "won"), torch.zeros(2, 1)))


def test_many_rows_of_which_none_can_be_relabelled_are_warned_of_once() -> None:
    stamp, environment = stamping(4), Environment()
    batches = [with_bonus(rows(*[STEP] * 100, environment=environment)) for _ in range(25)]
    with pytest.warns(UserWarning, match=r"None of 10\d\d rows can be relabelled.*success_threshold=0\.0") as record:
        [*map(stamp.inv, batches)]
    assert len(record) == 1


def test_one_usable_goal_is_enough_for_no_warning() -> None:
    stamp, environment = stamping(4), Environment()
    stamp.inv(rows(STEP, STEP, TRUNCATED, environment=environment))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(12):
            stamp.inv(with_bonus(rows(*[STEP] * 100, environment=environment)))


# Padding


@pytest.mark.parametrize("key", [("collector", "mask"), "mask"])
def test_zero_padded_trajectories_are_refused_with_the_remedy(key: NestedKey) -> None:
    stream = rows(STEP, STEP, STEP, TRUNCATED, STEP, TRUNCATED)
    stream["collector", "traj_ids"] = torch.tensor([0, 0, 0, 0, 1, 1])
    padded = split_trajectories(stream, prefix="collector")
    mask = padded["collector", "mask"]
    assert padded.shape == (2, 4)
    assert torch.equal(padded["pose"][1, 2:], torch.zeros(2, 4))
    stamp = stamping(3)
    with pytest.raises(ValueError, match=rf"2 of these 8 rows are padding: their mask, {dotted(key)}, .*split_trajs"):
        stamp.inv(padded.exclude("collector").set(key, mask))
    with pytest.raises(ValueError, match="2 of these 8 rows are padding"):
        stamp.inv(padded.reshape(-1))
    assert stamp.flush() is None


def test_a_mask_of_something_else_is_let_through() -> None:
    stream = rows(STEP, STEP, TRUNCATED).set("mask", torch.tensor([[True, False]]).expand(3, 2))
    assert len(stamping(3).inv(stream)) == 3
    assert len(stamping(3).inv(stream.set("mask", torch.ones(3, dtype=torch.bool)))) == 3


# Lazy stacks, as collectors give them to a buffer, and device labels


def lazy(*events: str, environment: Environment) -> TensorDictBase:
    return lazy_stack([TensorDict(environment.row(event)) for event in events])


def test_rows_in_lazy_stacks_are_left_as_they_are_and_stamped_alike() -> None:
    environment, twin, stamp, reference = Environment(), Environment(), stamping(3), stamping(3)
    for events in ([STEP] * 4, [STEP] * 2, [STEP, TRUNCATED, STEP]):
        batch = lazy(*events, environment=environment)
        before = batch.clone()
        assert_identical(stamp.inv(batch), reference.inv(rows(*events, environment=twin)))
        assert_identical(batch.contiguous(), before.contiguous())


def test_rows_of_lazy_stacks_are_recognised_when_they_were_flushed() -> None:
    stamp = stamping(4)
    buffer = ReplayBuffer(storage=LazyTensorStorage(10), transform=stamp, batch_size=2)
    buffer.extend(lazy(STEP, STEP, environment=Environment()))
    buffer.extend(lazy_stack(list(stamp.flush().unbind(0))))
    assert horizons(buffer[:]) == [2, 1]


@pytest.mark.parametrize("labels", itertools.product([None, "cpu"], repeat=3))
def test_any_mixture_of_device_labels_is_joined(labels: tuple) -> None:
    environment = Environment()
    batches = [rows(*events, environment=environment) for events in ([STEP] * 2, [STEP] * 3, [STEP, TRUNCATED])]
    plain, mixed = stamping(3), stamping(3)
    labelled = [batch.to("cpu") if label else batch.clone() for batch, label in zip(batches, labels, strict=True)]
    assert [batch.device and batch.device.type for batch in labelled] == list(labels)
    expected, actual = ([*map(stamp.inv, each)] for stamp, each in ((plain, batches), (mixed, labelled)))
    assert expected[0] is actual[0] is None
    for one, other in zip(expected[1:], actual[1:], strict=True):
        assert_identical(other, one)


def test_labels_may_differ_inside_rows_too() -> None:
    environment = Environment()
    first, second = rows(STEP, STEP, environment=environment), rows(STEP, TRUNCATED, environment=environment)
    first["next"] = first["next"].to("cpu")
    stamp = stamping(3)
    stamp.inv(first)
    assert len(stamp.inv(second)) == 4


# Bad arguments


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_step": 0.0}, "max_step must be positive, in metres, got 0.0"),
        ({"n_steps": 0}, "n_steps must be between 1 and max_distance=3, got 0"),
        ({"n_steps": 4, "discount": 0.9}, "n_steps must be between 1 and max_distance=3, got 4"),
        ({"n_steps": 2}, "n_steps=2 needs the discount of the loss, between 0 and 1, got None"),
        ({"n_steps": 2, "discount": 1.5}, "n_steps=2 needs the discount .* got 1.5"),
    ],
)
def test_arguments_out_of_range_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        stamping(3, **options)


@pytest.mark.parametrize("distance", [0, -3])
def test_looking_less_than_one_step_ahead_is_refused(distance: int) -> None:
    with pytest.raises(ValueError, match=f"max_distance must be at least 1 step, got {distance}"):
        stamping(distance)
