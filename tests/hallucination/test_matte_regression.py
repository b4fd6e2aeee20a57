import pytest
import torch
from torch import Tensor

from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.training.matte_regression import colour_index, goal_colours, warm_start
from halgan_rl.transforms.pixels import to_float, to_uint8
from tests import synthetic


def train(steps: int, seed: int = 0, *, flagged: bool = False) -> tuple[CoordinateGenerator, list[float]]:
    torch.manual_seed(0)
    data = synthetic.near_goal(256, flagged=flagged)
    generator = CoordinateGenerator(pose_size=data["pose"].shape[1])
    generator.encoding.standardise(generator.encoding.labels(data["pose"], data["goal_pose"]))
    rng = torch.Generator().manual_seed(seed)
    losses = warm_start(
        generator,
        near_goal=data,
        failed=synthetic.failed(flagged=flagged),
        steps=steps,
        rng=rng,
        batch_size=64,
        pixels=256,
    )
    return generator, list(losses)


def paint(generator: CoordinateGenerator, relative_pose: list[float]) -> Tensor:
    """Return what is painted into a black frame."""
    features = generator.encoding(torch.tensor([relative_pose]))
    with torch.no_grad():
        change = generator(features, torch.zeros(1, generator.latent_size))
    return to_uint8(generator.compose(to_float(torch.zeros(1, 64, 64, 3, dtype=torch.uint8)), change))[0].float()


def test_the_goal_is_painted_in_its_colour_where_the_relative_pose_has_it() -> None:
    generator, losses = train(100)
    assert losses[-1] < losses[0] / 5
    left, right = (paint(generator, [0.3, y, 0.0]) for y in (0.08, -0.08))
    assert left[32, 27, 0] > 120 > 40 > left[32, 27, 1]  # column 32 - 60 y
    assert right[32, 37, 0] > 120 > 40 > right[32, 37, 1]
    assert left[:8].max() < 20
    near, far = (paint(generator, [x, 0.0, 0.0])[..., 0].sum() for x in (0.1, 0.7))
    assert near > 2 * far


def test_flags_of_the_pose_choose_the_goal_also_if_its_colour_is_seen_everywhere_with_other_flags() -> None:
    generator = train(150, flagged=True)[0]
    red, green = (paint(generator, [0.3, 0.08, 0.0, flag])[32, 27] for flag in (0.0, 1.0))
    assert red[0] > 120 > 60 > red[1]
    assert green[1] > 120 > 60 > green[0]


def test_goals_without_failed_frames_to_paint_them_into_are_refused() -> None:
    data, failed = synthetic.near_goal(16, flagged=True), synthetic.failed(16, flagged=True)
    failed["pose"][:, 3] = 0
    with pytest.raises(ValueError, match=r"flags \[1\.0\].*no failed ones"):
        next(
            warm_start(CoordinateGenerator(pose_size=4), near_goal=data, failed=failed, steps=1, rng=torch.Generator())
        )


def test_what_the_pose_does_not_tell_is_sharp_only_if_the_latents_may_tell_it() -> None:
    data, failed = synthetic.near_goal(256), synthetic.failed()
    shifts = torch.randint(-12, 13, (256 // 8,), generator=torch.Generator().manual_seed(1)).repeat_interleave(8)
    rolled = [frame.roll(int(shift), 1) for frame, shift in zip(data["pixels"], shifts, strict=True)]
    data["pixels"] = torch.stack(rolled)

    def opacity(latent_noise: float) -> float:
        torch.manual_seed(0)
        generator, rng = CoordinateGenerator(), torch.Generator().manual_seed(0)
        labels = generator.encoding.labels(data["pose"], data["goal_pose"])
        generator.encoding.standardise(labels)
        size = {"batch_size": 64, "pixels": 128}
        losses = warm_start(
            generator, near_goal=data, failed=failed, steps=150, rng=rng, latent_noise=latent_noise, **size
        )
        assert len(list(losses)) == 150
        with torch.no_grad():
            matte = generator(generator.encoding(labels), generator.sample_latent(256, rng))
        return float(matte[:, 3].flatten(1).amax(1).mean())

    sharp, blurred = opacity(0.05), opacity(1.0)
    assert sharp > 1.3 * blurred


@pytest.mark.parametrize("noise", [-0.1, 1.1])
def test_a_share_of_noise_beyond_all_of_it_is_refused(noise: float) -> None:
    data, failed = synthetic.near_goal(16), synthetic.failed(16)
    rng = torch.Generator()
    with pytest.raises(ValueError, match=f"latent_noise={noise}"):
        next(warm_start(CoordinateGenerator(), near_goal=data, failed=failed, steps=1, rng=rng, latent_noise=noise))


def test_equal_seeds_give_equal_weights() -> None:
    one, same, other = (train(3, seed)[0].state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["paint.0.weight"], other["paint.0.weight"])


def test_the_goals_colours_are_those_that_failed_frames_lack() -> None:
    is_goal = goal_colours(synthetic.near_goal()["pixels"], synthetic.failed()["pixels"])
    colours = torch.tensor([[200, 20, 20], [120, 120, 120], [20, 200, 20]], dtype=torch.uint8)
    assert is_goal[colour_index(colours)].tolist() == [True, False, False]


def test_colours_are_told_apart_by_channel() -> None:
    colours = torch.tensor([[255, 0, 0], [0, 255, 0], [0, 0, 255], [0, 0, 15]], dtype=torch.uint8)
    assert colour_index(colours).tolist() == [15 * 256, 15 * 16, 15, 0]
