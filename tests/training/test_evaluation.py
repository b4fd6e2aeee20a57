"""Evaluation counts terminations, on the starts it was given."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses
from halgan_rl.training.evaluation import evaluate, record


class Corridor(EnvBase):
    """Starts at the seed; each step adds the action. Terminates at 3 or above, is truncated after 4 steps."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(
            position=Unbounded((1,)), pixels=Bounded(0, 255, (2, 2, 3), dtype=torch.uint8)
        )
        self.action_spec = Bounded(-1.0, 1.0, (1,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(
            {name: Binary(1, (1,), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        )
        self.start = 0

    def _set_seed(self, seed: int | None) -> None:
        self.start = seed or 0

    def _observe(self) -> dict[str, torch.Tensor]:
        return {
            "position": torch.tensor([self.position]),
            "pixels": torch.full((2, 2, 3), int(self.position), dtype=torch.uint8),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        self.position, self.time = float(self.start), 0
        return TensorDict(self._observe(), batch_size=[])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.position += float(tensordict["action"])
        self.time += 1
        terminated = torch.tensor([self.position >= 3])
        truncated = torch.tensor([self.time >= 4]) & ~terminated
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**self._observe(), "reward": torch.tensor([0.5]), **flags}, batch_size=[])


def walk(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.full((1,), 0.5))


def test_success_is_termination_and_not_the_time_limit() -> None:
    # From 2 it takes 2 steps; from 1 it takes 4, the last of which terminates; from 0 the time runs out at 4.
    result = evaluate(Corridor(), walk, seeds=[2, 1, 0])
    assert result.success_rate == pytest.approx(2 / 3)
    assert result.episode_length == pytest.approx((2 + 4 + 4) / 3)
    assert result.episode_return == pytest.approx((1.0 + 2.0 + 2.0) / 3)
    assert result.metrics("eval")["eval/success_rate"] == result.success_rate


def test_no_start_is_an_error() -> None:
    with pytest.raises(ValueError, match="seeds is empty"):
        evaluate(Corridor(), walk, seeds=[])


def test_success_is_a_flag_of_the_environment_if_its_key_is_given() -> None:
    result = evaluate(Flagged(), walk, seeds=[2, 1, 0], keys=Keys(success="passed"))
    assert result.success_rate == pytest.approx(1 / 3)  # of 2, 1 and 0, only from 1 the agent passes 1.5


def test_flags_are_reported_by_their_names_as_they_are_in_the_end() -> None:
    poses = PlanarPoses(flags=("far", "early"))
    result = evaluate(Flagged(), walk, seeds=[2, 1, 0], poses=poses, keys=Keys(pose=("robot", "pose")))
    assert result.flags == {"far": pytest.approx(2 / 3), "early": pytest.approx(1 / 3)}
    assert result.metrics()["eval/early"] == result.flags["early"]


def test_poses_with_other_flags_are_refused() -> None:
    with pytest.raises(ValueError, match=r"next.robot.pose.*must hold 4 floats"):
        evaluate(Flagged(), walk, seeds=[2], poses=PlanarPoses(flags=("far",)), keys=Keys(pose=("robot", "pose")))


def test_a_key_that_the_environment_does_not_write_is_named_with_the_field_that_set_it() -> None:
    with pytest.raises(KeyError, match=r"next.solved, set by keys=Keys\(success='solved'\).*next.passed"):
        evaluate(Flagged(), walk, seeds=[2], keys=Keys(success="solved"))


class Flagged(Corridor):
    """Says whether it is just beyond 1.5, which ends nothing, and in its pose whether it is beyond 2.5, or early."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(
            robot=Composite(pose=Unbounded((5,))), passed=Binary(1, (1,), dtype=torch.bool), **self.observation_spec
        )

    def _observe(self) -> dict[str, object]:
        pose = [self.position, 0.0, 0.0, float(self.position > 2.5), float(self.time < 3)]
        return {
            **super()._observe(),
            "robot": {"pose": torch.tensor(pose)},
            "passed": torch.tensor([1.5 <= self.position < 1.9 and self.time == 1]),
        }


def test_a_film_shows_both_views_from_the_first_to_the_last_frame() -> None:
    env = Corridor()
    frames = record(env, walk, lambda: np.full((4, 5, 3), 100 + env.time, dtype=np.uint8), seeds=[2, 1])
    assert [frame.shape for frame in frames] == [(4, 9, 3)] * (3 + 5)
    assert [int(frame[0, 0, 0]) for frame in frames] == [100, 101, 102, 100, 101, 102, 103, 104]
    assert [int(frame[3, 8, 0]) for frame in frames] == [2, 2, 3, 1, 1, 2, 2, 3]


class Camera(Corridor):
    """Has images of any shape, in which row, column and channel can be read: 50 row + 10 column + channel."""

    def __init__(self, *shape: int) -> None:
        super().__init__()
        height, width, channels = shape
        ramp = 50 * torch.arange(height)[:, None, None] + 10 * torch.arange(width)[:, None] + torch.arange(channels)
        self.image = ramp.to(torch.uint8)
        self.observation_spec = Composite(
            position=Unbounded((1,)), camera=Composite(rgb=Bounded(0, 255, shape, dtype=torch.uint8))
        )

    def _observe(self) -> dict[str, object]:
        return {"position": torch.tensor([self.position]), "camera": {"rgb": self.image}}


CAMERA = Keys(pixels=("camera", "rgb"))


def test_without_an_overview_a_film_shows_what_the_agent_sees_enlarged() -> None:
    frames = record(Camera(2, 3, 3), walk, seeds=[2], keys=CAMERA)
    assert [frame.shape for frame in frames] == [(256, 384, 3)] * 3
    assert frames[0][::128, ::128].tolist() == Camera(2, 3, 3).image.tolist()


def test_an_image_whose_height_does_not_divide_the_overviews_is_scaled_to_it() -> None:
    overview = np.full((7, 4, 3), 9, dtype=np.uint8)
    (frame, *_) = record(Camera(3, 6, 3), walk, lambda: overview, seeds=[2], keys=CAMERA)
    assert frame.shape == (7, 4 + 14, 3)
    assert (frame[:, :4] == 9).all()
    assert frame[:, 4, 0].tolist() == [0, 0, 0, 50, 50, 100, 100]
    assert frame[0, 4:, 0].tolist() == [0, 0, 0, 10, 10, 20, 20, 30, 30, 30, 40, 40, 50, 50]


@pytest.mark.parametrize(
    ("channels", "frame_stack", "shown"),
    [(1, 1, [0, 0, 0]), (3, 1, [0, 1, 2]), (4, 4, [3, 3, 3]), (12, 4, [9, 10, 11])],
)
def test_of_stacked_frames_the_last_is_filmed_in_rgb_or_grey(channels: int, frame_stack: int, shown: list[int]) -> None:
    frames = record(Camera(2, 2, channels), walk, seeds=[2], keys=CAMERA, frame_stack=frame_stack)
    assert frames[0].dtype == np.uint8
    assert frames[0][0, 0].tolist() == shown


def test_an_image_of_other_channels_is_refused_with_the_remedy() -> None:
    with pytest.raises(ValueError, match=r"camera.rgb is torch.uint8 \(2, 2, 12\).*frame_stack=1"):
        record(Camera(2, 2, 12), walk, seeds=[2], keys=CAMERA)
