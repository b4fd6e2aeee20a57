import numpy as np
import pytest

from halgan_envs.rendering.persistent_camera import PersistentCamera


def test_images_are_upright(stage):
    stage.place((-0.5, 0.0, 0.0))
    image = stage.robot.camera.render(stage.physics).astype(int)
    wall, floor = image[2].mean(axis=0), image[-2].mean(axis=0)
    assert wall[2] > wall[0]  # The bluish wall is above,
    assert abs(floor[2] - floor[0]) < 25  # the grey floor below.


def test_left_is_left(stage):
    stage.place((0.0, 0.0, 0.0), box=(0.4, 0.1))
    image = stage.robot.camera.render(stage.physics).astype(int)
    columns = ((image[..., 0] > 100) & (image[..., 1] < 60)).any(axis=0).nonzero()[0]
    assert 0 < columns.max() < 32


def test_it_agrees_with_dm_control_s_own_renderer(stage):
    """Within the difference that a slower renderer with shadows off and anti-aliasing makes at edges."""
    stage.place((-0.3, 0.2, -0.5), box=(0.1, 0.0))
    ours = stage.robot.camera.render(stage.physics).astype(int)
    stock = stage.physics.render(64, 64, camera_id="rover/egocentric").astype(int)
    assert np.abs(ours - stock).mean() < 3


def test_an_unknown_camera_lists_the_known_ones(stage):
    with pytest.raises(ValueError, match=r"'nose'.*rover/egocentric"):
        PersistentCamera(stage.physics, "nose")
