import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from halgan_rl.transforms import DrawHindsightGoal
from halgan_rl.transforms.annealing import Annealing
from tests.transforms.rows import always, assert_identical, random_source

STEPS = 8


def rows(count: int, horizon: int | list[int] = STEPS) -> TensorDict:
    """Rows that stand at x = 0 and, d steps later, at x = d."""
    future = torch.zeros(count, STEPS, 3)
    future[..., 0] = torch.arange(1, STEPS + 1)
    horizon = torch.as_tensor(horizon).expand(count)[:, None]
    return TensorDict(
        {"pose": torch.zeros(count, 3), "hindsight": {"pose": future, "horizon": horizon}}, batch_size=[count]
    )


def draw(probability: float | Annealing = 1.0, *, seed: int = 0, **options: object) -> DrawHindsightGoal:
    annealing = probability if isinstance(probability, Annealing) else always(probability)
    return DrawHindsightGoal(annealing, rng=random_source(seed), **options)


def offsets(out: TensorDictBase) -> torch.Tensor:
    return out["goal", "pose"][:, 0].long()


def test_probability_zero_relabels_no_row() -> None:
    assert not draw(0.0)(rows(10_000))["goal", "mask"].any()


def test_probability_zero_relabels_no_row_even_at_the_lowest_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DrawHindsightGoal, "_uniform", lambda self, like: torch.zeros(like.shape))
    assert not draw(0.0)(rows(3))["goal", "mask"].any()


def test_probability_one_relabels_every_row_with_a_future() -> None:
    horizon = [0, 1, 2, 0, 8]
    assert draw(1.0)(rows(5, horizon))["goal", "mask"].flatten().tolist() == [False, True, True, False, True]


@pytest.mark.parametrize("probability", [0.1, 0.3, 0.7])
def test_rows_are_relabelled_at_the_given_rate(probability: float) -> None:
    rate = draw(probability)(rows(20_000))["goal", "mask"].float().mean().item()
    assert rate == pytest.approx(probability, abs=4 * math.sqrt(probability * (1 - probability) / 20_000))


@pytest.mark.parametrize("horizon", [1, 2, 5, STEPS])
def test_the_offset_is_uniform_on_one_to_the_horizon(horizon: int) -> None:
    count = torch.bincount(offsets(draw()(rows(20_000, horizon))), minlength=STEPS + 1)
    fraction = 1 / horizon
    expected = torch.tensor([fraction if 1 <= d <= horizon else 0.0 for d in range(STEPS + 1)]) * 20_000
    assert (count - expected).abs().max() <= 4 * math.sqrt(20_000 * fraction * (1 - fraction))


@pytest.mark.parametrize("nearness", [1.5, 2.0, 4.0])
def test_nearness_raises_the_fraction_of_near_goals(nearness: float) -> None:
    count = torch.bincount(offsets(draw(nearness=nearness)(rows(20_000))), minlength=STEPS + 1)[1:]
    edges = (torch.arange(STEPS + 1) / STEPS) ** (1 / nearness)
    expected = 20_000 * edges.diff()
    assert (count - expected).abs().max() <= 4 * expected.max().sqrt()


@pytest.mark.parametrize("nearness", [0.5, float("nan")])
def test_a_preference_for_far_goals_is_refused(nearness: float) -> None:
    with pytest.raises(ValueError, match="nearness must be at least 1"):
        draw(nearness=nearness)


def test_whether_and_where_are_drawn_independently() -> None:
    out = draw(0.5)(rows(20_000))
    relabelled = offsets(out)[out["goal", "mask"].flatten()].float()
    assert relabelled.mean().item() == pytest.approx((STEPS + 1) / 2, abs=0.1)


def test_a_row_at_its_goal_is_not_relabelled() -> None:
    standing = rows(4)
    standing["hindsight", "pose"][1:3] = torch.tensor([0.005, 0.0, 0.05])
    standing["hindsight", "pose"][2, :, 2] = 0.5  # same place, another heading
    assert draw()(standing)["goal", "mask"].flatten().tolist() == [True, False, True, True]


def test_a_row_at_its_goal_is_relabelled_on_request() -> None:
    standing = rows(4)
    standing["hindsight", "pose"].zero_()
    assert draw(skip_reached=False)(standing)["goal", "mask"].all()


def test_goals_are_later_poses_and_never_the_rows_own() -> None:
    assert offsets(draw(skip_reached=False)(rows(1_000))).min() == 1


def test_the_mask_and_pose_have_the_shapes_of_the_contract() -> None:
    out = draw(0.5)(rows(6))
    assert out["goal", "mask"].shape == (6, 1)
    assert out["goal", "mask"].dtype == torch.bool
    assert out["goal", "pose"].shape == (6, 3)


def test_the_same_seed_draws_the_same_goals() -> None:
    assert_identical(draw(0.5, seed=3)(rows(64)), draw(0.5, seed=3)(rows(64)))
    assert not torch.equal(offsets(draw(0.5, seed=3)(rows(64))), offsets(draw(0.5, seed=4)(rows(64))))


def test_the_probability_is_annealed_linearly_and_then_stays() -> None:
    transform = draw(Annealing(0.3, 0.1, 100))
    seen = [transform.probability]
    for frames in (25, 25, 50, 1_000):
        transform.step(frames)
        seen.append(transform.probability)
    assert seen == pytest.approx([0.3, 0.25, 0.2, 0.1, 0.1])


def test_one_call_of_many_frames_anneals_like_many_calls_of_one() -> None:
    many, one = draw(Annealing(0.3, 0.0, 7)), draw(Annealing(0.3, 0.0, 7))
    for _ in range(5):
        many.step()
    one.step(5)
    assert many.probability == one.probability


def test_the_annealed_probability_is_the_one_used() -> None:
    transform = draw(Annealing(1.0, 0.0, 10))
    transform.step(10)
    assert not transform(rows(1_000))["goal", "mask"].any()


def test_the_frames_and_the_rng_round_trip_through_the_state_dict() -> None:
    transform = draw(Annealing(0.9, 0.0, 10), seed=1)
    transform.step(3)
    transform(rows(5))
    other = draw(Annealing(0.9, 0.0, 10), seed=2)
    other.load_state_dict(transform.state_dict())
    assert_identical(other(rows(64)), transform(rows(64)))
    for each in (transform, other):
        each.step(4)
    assert other.probability == transform.probability
    assert other.probability == pytest.approx(0.9 * 0.3)


def test_the_rng_must_be_given() -> None:
    with pytest.raises(TypeError, match="rng"):
        DrawHindsightGoal()  # type: ignore[call-arg]


@pytest.mark.parametrize("value", [-0.1, 1.5, math.nan])
@pytest.mark.parametrize("name", ["start", "end"])
def test_a_probability_outside_zero_to_one_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"^probability\.{name} must lie in \[0, 1\], got {value}"):
        draw(replace(Annealing(0.3, 0.1, 10), **{name: value}))
