import numpy as np
import pytest

import halgan_envs
from halgan_envs.near_goal import collect_failed, collect_near_goal


@pytest.fixture(scope="module")
def near_goal():
    environment = halgan_envs.navigate_2m(random_state=1)
    snapshots = collect_near_goal(environment, 150, np.random.RandomState(2))
    environment.close()
    return snapshots


def test_exactly_as_many_as_asked_for_come_out(near_goal):
    assert {key: (value.shape, value.dtype) for key, value in near_goal.items()} == {
        "pixels": ((150, 64, 64, 3), np.uint8),
        "pose": ((150, 3), np.float32),
        "goal_pose": ((150, 3), np.float32),
    }


def test_the_goal_pose_is_where_the_rollout_ended(near_goal):
    distance = np.hypot(*(near_goal["pose"] - near_goal["goal_pose"])[:, :2].T)
    assert (distance <= 33 * 0.05).all()
    assert (near_goal["pose"] == near_goal["goal_pose"]).all(axis=1).any()


def test_the_box_is_in_the_final_images(near_goal):
    final = (near_goal["pose"] == near_goal["goal_pose"]).all(axis=1)
    for image in near_goal["pixels"][final].astype(int):
        assert ((image[..., 0] > 100) & (image[..., 1] < 60)).mean() > 0.1


def test_images_belong_to_their_poses(near_goal):
    renderer = halgan_envs.GoalRenderer("navigate-2m")
    row = int(np.hypot(*(near_goal["pose"] - near_goal["goal_pose"])[:, :2].T).argmax())
    ours = renderer.render(near_goal["pose"][row].astype(float)).astype(int)
    renderer.close()
    assert np.median(np.abs(ours - near_goal["pixels"][row])) <= 1


def test_driving_repeats_by_seed():
    first, again = (drive(seed=3) for _ in range(2))
    np.testing.assert_array_equal(first["pixels"], again["pixels"])
    assert (first["pose"] != drive(seed=4)["pose"]).any()


def drive(seed):
    environment = halgan_envs.navigate_2m(random_state=0)
    snapshots = collect_near_goal(environment, 40, np.random.RandomState(seed), steps_before_goal=9, noise=(0.2, 0.5))
    environment.close()
    return snapshots


def test_failed_snapshots_come_from_unsuccessful_wandering(room_2m):
    failed = collect_failed(room_2m, 250, np.random.RandomState(0))
    assert failed["pixels"].shape == (250, 64, 64, 3)
    assert failed["pose"].shape == (250, 3)
    # The first episode whole, and the beginning of the next.
    jumps = np.hypot(*np.diff(failed["pose"][:, :2], axis=0).T) > 0.06
    assert jumps.nonzero()[0].tolist() == [200]
    assert np.array_equal(failed["episode"], np.arange(250) > 200)


@pytest.mark.parametrize("collect", [collect_near_goal, collect_failed])
def test_a_count_below_one_is_refused(room_2m, collect):
    with pytest.raises(ValueError, match="count must be positive; got 0"):
        collect(room_2m, 0, np.random.RandomState(0))


def test_a_hopeless_driver_is_reported():
    environment = halgan_envs.navigate_2m(random_state=0, time_limit=0.2)
    with pytest.raises(RuntimeError, match="failed 100 times in a row"):
        collect_near_goal(environment, 5, np.random.RandomState(0))
    environment.close()
