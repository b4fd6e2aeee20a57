"""After close, a reset, a step or a picture raises an error with the remedy."""

import gymnasium
import numpy as np
import pytest
import torch

import halgan_envs
from halgan_envs.rendering.persistent_camera import PersistentCamera

ACTION = np.array([0.5, -0.2], np.float32)


def composer_environment():
    environment = halgan_envs.navigate_2m(random_state=0)
    environment.reset()
    return environment, {
        "reset": environment.reset,
        "reset_to": lambda: environment.reset_to({"pose": (0.0, 0.1, 0.2)}),
        "step": lambda: environment.step(ACTION),
        "render_overview": environment.render_overview,
        "physics": lambda: environment.physics,
        "camera": lambda: environment.task.robot.camera.render(None),
    }


def torchrl_adapter():
    env = halgan_envs.make("navigate-2m", seed=0)
    row = env.rand_action(env.reset())
    return env, {
        "reset": env.reset,
        "step": lambda: env.step(row),
        "rollout": lambda: env.rollout(2),
        "render_overview": env.render_overview,
    }


def gymnasium_adapter():
    env = gymnasium.make(halgan_envs.gymnasium_id("navigate-2m"), render_mode="rgb_array")
    env.reset(seed=0)
    return env, {"reset": env.reset, "step": lambda: env.step(ACTION), "render": env.render}


def goal_renderer():
    renderer = halgan_envs.GoalRenderer("navigate-2m")
    pixels, pose = torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8), torch.zeros(1, 1, 3)
    return renderer, {
        "render": lambda: renderer.render(np.zeros(3)),
        "call": lambda: renderer(pixels, pose, pose),
        "call without rows": lambda: renderer(pixels[:0], pose[:0], pose[:0]),
    }


@pytest.mark.parametrize("build", [composer_environment, torchrl_adapter, gymnasium_adapter, goal_renderer])
def test_what_is_closed_says_so_and_names_the_remedy(build):
    closed, uses = build()
    closed.close()
    for name, use in uses.items():
        with pytest.raises(RuntimeError, match=r"is closed: make a new"):
            pytest.fail(f"{name} returned {use()}")
    closed.close()


def test_a_camera_of_a_closed_environment_says_so_and_names_the_remedy():
    environment = halgan_envs.navigate_2m(random_state=0)
    environment.reset()
    physics = environment.physics
    camera = PersistentCamera(physics, "overview")
    environment.close()
    with pytest.raises(RuntimeError, match="environment of this camera is closed: make a new one"):
        camera.render(physics)
    camera.close()
