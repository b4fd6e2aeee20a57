"""Poses that a pipeline does not understand are refused as they are written; a user's own are understood."""

from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Compose

from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.transforms import DrawHindsightGoal, HallucinateGoal, HindsightReward, StampFuturePoses
from tests.transforms.rows import always, assert_identical, random_source

DISTANCE = 5


@dataclass(frozen=True)
class FlyingPoses:
    """A user's own: x, y, z [m] and a unit quaternion w, x, y, z."""

    distance: float = 0.05
    angle: float = 0.1

    def check(self, pose: Tensor, name: str) -> None:
        if pose.shape[-1] != 7 or not torch.allclose(pose[..., 3:].norm(dim=-1), torch.tensor(1.0)):
            raise ValueError(f"{name} is no position with a unit quaternion")

    def stage_changed(self, pose: Tensor, next_pose: Tensor) -> Tensor:
        return torch.zeros(pose.shape[:-1], dtype=torch.bool)

    def travelled(self, pose: Tensor, next_pose: Tensor) -> Tensor:
        return (next_pose[..., :3] - pose[..., :3]).norm(dim=-1)

    def reached(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        near = (goal_pose[..., :3] - pose[..., :3]).norm(dim=-1) < self.distance
        turned = 2 * (pose[..., 3:] * goal_pose[..., 3:]).sum(-1).abs().clamp(max=1).acos()
        return near & (turned < self.angle)


def flight(length: int) -> Tensor:
    """Poses ``[length, 7]`` of a spiral that rises; every fourth step it stands still."""
    moved = torch.arange(length) * 3 // 4
    half = 0.15 * moved
    still = torch.zeros(length)
    quaternion = torch.stack([half.cos(), still, still, half.sin()], dim=-1)
    position = torch.stack([0.2 * half.cos(), 0.2 * half.sin(), 0.125 * moved], dim=-1)
    return torch.cat([position, quaternion], dim=-1)


def rows_with(pose: Tensor) -> TensorDict:
    """One episode with poses ``[T + 1, P]``, cut by its time limit."""
    count = len(pose) - 1
    pixels = torch.zeros(count + 1, 4, 5, 3, dtype=torch.uint8)
    pixels[:, 1, 2, 0] = torch.arange(count + 1).to(torch.uint8)
    last = torch.zeros(count, 1, dtype=torch.bool)
    last[-1] = True
    following = {
        "pixels": pixels[1:],
        "pose": pose[1:],
        "reward": torch.full((count, 1), -0.25),
        "done": last,
        "terminated": torch.zeros_like(last),
        "truncated": last.clone(),
    }
    return TensorDict({"pixels": pixels[:-1], "pose": pose[:-1], "next": following}, batch_size=[count])


def count_entries(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """A hallucinator that paints how many entries a pose and a goal pose have."""
    painted = pixels.clone()
    painted[..., 0, 0, 0], painted[..., 0, 0, 1] = pose.shape[-1], goal_pose.shape[-1]
    return painted


def buffer_for(poses: Poses, **options: float) -> TensorDictReplayBuffer:
    pipeline = Compose(
        StampFuturePoses(DISTANCE, poses=poses, **options),
        DrawHindsightGoal(always(1.0), rng=random_source(), poses=poses),
        HallucinateGoal(count_entries),
        HindsightReward(poses=poses),
    )
    return TensorDictReplayBuffer(storage=FrameStorage(100), transform=pipeline, batch_size=200)


REFUSED = {
    "quaternion": (PlanarPoses(), flight(9), r"the entry pose is torch\.float32 \(1, 8, 7\).* 3 floats"),
    "z before yaw": (PlanarPoses(), flight(9)[:, [0, 1, 2, 6]], r"\(1, 8, 4\).*PlanarPoses\(flags=\(\.\.\.\)\)"),
    "speed": (PlanarPoses(flags=("held",)), flight(9)[:, [0, 1, 6, 4]] + 0.3, r"flags \(held\) must be 0 or 1"),
    "joint angles": (
        PlanarPoses(flags=("open", "held")),
        torch.cat([flight(9)[:, [0, 1, 6]], torch.linspace(0, 2, 18).view(9, 2)], 1),
        r"flags \(open, held\) must be 0 or 1: pass numbers .* under another key, or give a poses object",
    ),
    "no yaw": (PlanarPoses(), flight(9)[:, :2], r"\(1, 8, 2\).* x \[m\], y \[m\], yaw \[rad\]"),
    "integers": (PlanarPoses(), torch.zeros(9, 3, dtype=torch.int64), r"torch\.int64 .* 3 floats"),
    "not a number": (PlanarPoses(), flight(9)[:, [0, 1, 6]] * float("nan"), "not finite.*Mend the pose observation"),
}


@pytest.mark.parametrize(("poses", "pose", "message"), REFUSED.values(), ids=REFUSED)
def test_poses_that_mean_something_else_are_refused_with_the_remedy(
    poses: PlanarPoses, pose: Tensor, message: str
) -> None:
    buffer = buffer_for(poses)
    with pytest.raises(ValueError, match=message):
        buffer.extend(rows_with(pose))
    assert len(buffer) == buffer.write_count == 0
    assert buffer._transform[0].flush() is None


def test_the_next_pose_is_checked_as_well() -> None:
    rows = rows_with(flight(9)[:, [0, 1, 6]])
    rows["next", "pose"] = torch.cat([rows["next", "pose"], torch.full((8, 1), 0.5)], dim=1)
    with pytest.raises(ValueError, match=r"the entry next\.pose is torch\.float32 \(1, 8, 4\)"):
        buffer_for(PlanarPoses()).extend(rows)


def test_a_users_own_poses_work_through_the_whole_pipeline() -> None:
    poses, rows = FlyingPoses(), rows_with(flight(41))
    buffer = buffer_for(poses, max_step=0.2)
    for part in rows.split(7):
        buffer.extend(part)
    assert len(buffer) == 40
    sample = buffer.sample()
    mask, goal, after = sample["goal", "mask"].flatten(), sample["goal", "pose"], sample["next", "pose"]
    assert goal.shape == (200, 7)
    assert 100 < mask.sum() <= 200
    reached = mask & poses.reached(after, goal)
    assert 20 < reached.sum() < mask.sum() - 20
    assert torch.equal(sample["next", "terminated"].flatten(), reached)
    assert torch.equal(sample["next", "reward"].flatten(), torch.where(reached, 0.75, -0.25))
    assert torch.equal(sample["pixels"][mask][:, 0, 0, :2], torch.full((int(mask.sum()), 2), 7, dtype=torch.uint8))
    stored = buffer.storage[:]["hindsight", "pose"][sample["index"][mask]]
    assert (stored == goal[mask, None]).all(-1).any(-1).all(), "a goal that is none of the row's futures"


def test_a_users_own_poses_are_checked_too() -> None:
    pose = flight(9)
    pose[4, 3:] *= 2
    with pytest.raises(ValueError, match=r"the entry pose is no position with a unit quaternion"):
        buffer_for(FlyingPoses()).extend(rows_with(pose))


def test_a_users_own_length_of_a_step_is_used() -> None:
    pose = flight(9)
    pose[:, 2] *= 4
    rows = rows_with(pose)
    with pytest.raises(ValueError, match=r"further than max_step=0\.2 m"):
        buffer_for(FlyingPoses(), max_step=0.2).extend(rows)
    unlimited = buffer_for(FlyingPoses())
    unlimited.extend(rows)
    assert_identical(unlimited.storage[:].exclude("hindsight", "index"), rows)
