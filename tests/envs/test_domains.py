"""The domain of each named environment: a frozen value that is built once and agrees with the environment."""

import dataclasses
import pickle

import numpy as np
import pytest

import halgan_envs


@pytest.fixture(params=sorted(halgan_envs.NAMES))
def domain(request):
    return halgan_envs.domain(request.param)


def test_the_first_call_builds_one_environment_and_the_second_none(monkeypatch):
    built = []

    def look(random_state=None):
        built.append(halgan_envs.navigate_2m(random_state=random_state))
        return built[-1]

    monkeypatch.setitem(halgan_envs.NAMES, "look-2m", look)
    first = halgan_envs.domain("look-2m")
    assert len(built) == 1
    assert halgan_envs.domain("look-2m") is first
    assert first.goal_renderer() is first.goal_renderer()
    assert first.goal_renderer().environment is built[0]
    assert len(built) == 1
    first.make(seed=3).close()  # a name that a user added is made like the others
    assert len(built) == 2
    built[0].close()


def test_another_function_under_the_same_name_has_another_domain(monkeypatch):
    monkeypatch.setitem(halgan_envs.NAMES, "look", lambda random_state=None: halgan_envs.navigate_2m(random_state))
    first = halgan_envs.domain("look")
    monkeypatch.setitem(
        halgan_envs.NAMES, "look", lambda random_state=None: halgan_envs.pick_and_place_2m(random_state)
    )
    assert (first.poses.flags, halgan_envs.domain("look").poses.flags) == ((), ("held",))


def test_it_is_frozen_and_pickles(domain):
    with pytest.raises(dataclasses.FrozenInstanceError):
        domain.name = "other"
    copy = pickle.loads(pickle.dumps(domain))
    assert copy.fingerprint == domain.fingerprint
    assert copy.goal_renderer() is domain.goal_renderer()


def test_it_describes_the_environment_that_it_makes(domain):
    env = domain.make(seed=0)
    row = env.reset()
    assert env.action_spec == domain.action_spec
    assert row["pixels"].shape == domain.image_shape
    assert row["pose"].shape == (domain.poses.size,)
    domain.poses.check(row["pose"], "pose")
    task = env.environment.task
    for setting, offset in enumerate(domain.poses.goal_offsets):
        flags = [setting >> bit & 1 for bit in range(len(domain.poses.flags))]
        assert task.goal(np.array([0.0, 0.0, 0.0, *flags])).offset == pytest.approx(offset)
    env.close()


def test_its_overview_is_a_picture_of_the_size_that_is_given(domain):
    env = domain.make(seed=0)
    env.reset()
    picture = domain.overview(env, 60, 80)
    env.close()
    assert (picture.shape, picture.dtype) == ((60, 80, 3), np.uint8)
    assert picture.std() > 10


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'navigate-3m'.*navigate-2m, navigate-4m"):
        halgan_envs.domain("navigate-3m")
