import numpy as np
import pytest
import torch

import halgan_envs
from halgan_envs.rendering.fingerprint import fingerprint


@pytest.fixture(scope="module")
def renderer():
    renderer = halgan_envs.GoalRenderer("navigate-2m")
    yield renderer
    renderer.close()


def test_it_renders_what_the_environment_shows(renderer, room_2m):
    for _ in range(5):
        room_2m.reset()
        for _ in range(3):
            observation = room_2m.step(np.array([0.7, -0.4])).observation
        box = room_2m.task.goals["box"].prop.position(room_2m.physics)
        frame = renderer.render(room_2m.task.robot.pose(room_2m.physics), box)
        np.testing.assert_array_equal(frame, observation["pixels"])


def test_the_box_stands_ahead_of_the_goal_pose(renderer):
    pose, goal_pose = np.array([0.5, 0.0, 0.7]), np.array([0.2, 0.3, 0.5 * np.pi])
    np.testing.assert_allclose(renderer.goal_position(pose, goal_pose), [0.2, 0.44], atol=1e-9)


def test_the_goal_is_seen_from_the_pose_not_from_the_goal(renderer):
    pose, goal = torch.tensor([-0.3, 0.0, 0.0]), torch.tensor([0.1, 0.1, 0.5])
    empty = torch.from_numpy(renderer.render_without_goal(pose.double().numpy()))
    (frame,) = renderer(empty.view(1, 1, 64, 64, 3), pose.view(1, 1, 3), goal.view(1, 1, 3))[0]
    pose, goal = pose.double().numpy(), goal.double().numpy()
    expected = renderer.render(pose, renderer.goal_position(pose, goal))
    np.testing.assert_array_equal(frame.numpy(), expected)


def test_each_frame_of_a_row_sees_the_row_s_goal(renderer):
    generator = torch.Generator().manual_seed(0)
    pose = torch.rand(3, 2, 4, generator=generator) - 0.5  # A fourth entry: a task flag.
    goal_pose = torch.rand(3, 1, 4, generator=generator) - 0.5
    pixels = torch.randint(0, 255, (3, 2, 64, 64, 3), dtype=torch.uint8, generator=generator)
    before = pixels.clone()
    frames = renderer(pixels, pose, goal_pose)
    assert frames.shape == pixels.shape
    assert frames.dtype == torch.uint8
    assert torch.equal(pixels, before)
    for row in range(3):
        for frame in range(2):
            one = renderer(
                pixels[row : row + 1, frame : frame + 1],
                pose[row : row + 1, frame : frame + 1],
                goal_pose[row : row + 1],
            )
            assert torch.equal(one[0, 0], frames[row, frame])


def test_no_rows_give_no_frames(renderer):
    empty = renderer(torch.zeros(0, 2, 64, 64, 3, dtype=torch.uint8), torch.zeros(0, 2, 3), torch.zeros(0, 1, 3))
    assert empty.shape == (0, 2, 64, 64, 3)


def test_the_goal_adds_red_and_leaving_it_out_removes_it(renderer):
    pose = np.array([0.0, 0.1, 0.0])
    with_goal, without = renderer.render(pose, np.array([0.14, 0.1])), renderer.render_without_goal(pose)
    assert red(with_goal).mean() > 0.2
    assert not red(without).any()


def red(image):
    image = image.astype(int)
    return (image[..., 0] > 100) & (image[..., 1] < 60) & (image[..., 2] < 60)


def test_a_pose_with_nan_is_refused(renderer):
    with pytest.raises(ValueError, match=r"pose \[0.0, nan, 0.0\].*finite"):
        renderer.render(np.array([0.0, np.nan, 0.0]))


def test_a_pose_without_yaw_is_refused(renderer):
    pixels = torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8)
    with pytest.raises(ValueError, match=r"x, y, yaw.*2"):
        renderer(pixels, torch.zeros(1, 1, 2), torch.zeros(1, 1, 2))


def test_rendering_after_close_says_so():
    renderer = halgan_envs.GoalRenderer("navigate-2m")
    camera = renderer.environment.task.robot.camera
    renderer.close()
    renderer.close()
    with pytest.raises(RuntimeError, match="closed"):
        camera.render(None)


def test_a_fingerprint_differs_between_rooms_and_repeats():
    first, again, other = (
        fingerprint(name, halgan_envs.domain(name).goal_renderer())
        for name in ("navigate-2m", "navigate-2m", "navigate-4m")
    )
    assert first == again == halgan_envs.domain("navigate-2m").fingerprint
    assert first["golden_frame"] != other["golden_frame"]
    assert set(first) == {"environment", "mujoco", "gl", "golden_frame"}
    assert len(first["golden_frame"]) == 64


def test_all_but_the_box_is_kept(renderer):
    pixels = torch.full((1, 1, 64, 64, 3), 77, dtype=torch.uint8)
    pose, goal = torch.tensor([[[0.0, 0.0, 0.3]]]), torch.tensor([[[0.2, 0.0, 0.0]]])
    (image,) = renderer(pixels, pose, goal)[0]
    kept = (image == 77).all(-1)
    assert 0.02 < (~kept).float().mean() < 0.5
    assert (image[~kept][:, 0] > 1.5 * image[~kept][:, 1:].amax(-1)).float().mean() > 0.9  # Red.
    assert (pixels == 77).all()


def test_no_wall_hides_the_box(renderer):
    empty = torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8)
    pose, goal = torch.tensor([[[0.5, 0.0, 0.0]]]), torch.tensor([[[0.94, 0.0, 0.0]]])
    assert renderer(empty, pose, goal).any()
    box = renderer.goal_position(pose[0, 0].numpy(), goal[0, 0].double().numpy())
    assert box[0] > 1.04  # Wholly inside the wall ...
    np.testing.assert_array_equal(renderer.render(pose[0, 0].numpy(), box), renderer.render(pose[0, 0].numpy()))
