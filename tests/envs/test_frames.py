"""Frames of named environments: with the goal, without it, and with the goal put back."""

import pytest
import torch

import halgan_envs


@pytest.fixture(scope="module")
def renderer():
    return halgan_envs.domain("navigate-2m").goal_renderer()


def test_equal_seeds_give_equal_frames_and_other_seeds_do_not():
    first, same, other = (halgan_envs.near_goal_frames("navigate-2m", 20, seed=seed) for seed in (0, 0, 1))
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not torch.equal(first["pixels"], other["pixels"])


def test_the_truth_is_what_was_seen(renderer):
    """The goal is taken out of real frames and rendered again at its own place: only its turn differs."""
    frames = halgan_envs.near_goal_frames("navigate-2m", 40, seed=0, steps_before_goal=9)
    seen = halgan_envs.with_truth(frames, renderer)
    goal = (frames["pixels"] != seen["pixels"]).any(-1)
    again = (seen["truth"] != seen["pixels"]).any(-1)
    assert goal.any()
    overlap = (goal & again).sum() / (goal | again).sum()
    assert overlap > 0.7
    assert set(seen) == {"pixels", "pose", "goal_pose", "truth"}


def test_frames_are_left_as_they_were(renderer):
    frames = halgan_envs.near_goal_frames("navigate-2m", 5, seed=0, steps_before_goal=2)
    before = frames["pixels"].clone()
    empty = halgan_envs.without_goal(frames, renderer)["pixels"]
    assert torch.equal(frames["pixels"], before)
    assert not torch.equal(empty, before)
