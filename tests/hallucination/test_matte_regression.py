from typing import Any

import pytest
import torch
from torch import Tensor

from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.judging.fidelity import compare
from halgan_rl.hallucination.training.matte_regression import MatteConfig, MatteRegression, colour_index, goal_colours
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms.pixels import to_float, to_uint8
from tests import synthetic

HELD = PlanarPoses(flags=("held",))


def train(steps: int, seed: int = 0, *, flagged: bool = False, **shape: Any) -> tuple[CoordinateGenerator, list[float]]:
    torch.manual_seed(0)
    data = synthetic.near_goal(256, flagged=flagged, **shape)
    generator = CoordinateGenerator(pose_size=data["pose"].shape[1], **shape)
    generator.encoding.standardise(generator.encoding.labels(data["pose"], data["goal_pose"]))
    regression = MatteRegression(
        generator,
        near_goal=data,
        failed=synthetic.failed(flagged=flagged, **shape),
        rng=torch.Generator().manual_seed(seed),
        config=MatteConfig(steps=steps, batch_size=64, pixels=256),
        poses=HELD if flagged else PlanarPoses(),
    )
    return generator, [float(regression.step()["loss"]) for _ in range(steps)]


def paint(generator: CoordinateGenerator, relative_pose: list[float]) -> Tensor:
    """Returns what is painted into a black frame."""
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


@pytest.mark.parametrize("shape", ["64x64x3", *synthetic.SHAPES])
def test_the_goal_is_painted_where_it_truly_is_whatever_the_shape_of_images(shape: str) -> None:
    """Pixels of 64x64 frames looked up in 84x84 ones give an overlap of 0.0."""
    image_shape, frame_stack = synthetic.SHAPES.get(shape, (synthetic.RGB, 1))
    settings: dict[str, Any] = {"image_shape": image_shape, "frame_stack": frame_stack}
    generator, _ = train(150, **settings)
    held_out = synthetic.near_goal(32, seed=7, **settings)
    paint = GeneratorHallucinator(generator, rng=torch.Generator().manual_seed(0))
    rows = (held_out[name].unsqueeze(1) for name in ("empty", "pose", "goal_pose"))
    painted = paint(*rows).squeeze(1)
    found = compare(held_out["empty"], held_out["pixels"], painted, frame_stack=frame_stack)
    assert found.mask_overlap > 0.5
    assert found.outside_change < 5


def fit(generator: Any, near_goal: dict[str, Tensor], failed: dict[str, Tensor], **options: Any) -> None:
    """Makes one step."""
    config = MatteConfig(steps=1, batch_size=4, pixels=16)
    rng = torch.Generator()
    MatteRegression(generator, near_goal=near_goal, failed=failed, config=config, rng=rng, **options).step()


def test_goals_without_failed_frames_to_paint_them_into_are_refused() -> None:
    data, failed = synthetic.near_goal(16, flagged=True), synthetic.failed(16, flagged=True)
    failed["pose"][:, 3] = 0
    with pytest.raises(ValueError, match=r"flags \[1\.0\].*no failed ones"):
        fit(CoordinateGenerator(pose_size=4), data, failed, poses=HELD)


def chw(data: dict[str, Tensor]) -> dict[str, Tensor]:
    return data | {"pixels": data["pixels"].permute(0, 3, 1, 2)}


def floats(data: dict[str, Tensor]) -> dict[str, Tensor]:
    return data | {"pixels": data["pixels"] / 255}


@pytest.mark.parametrize(
    ("near_goal", "failed", "message"),
    [
        (synthetic.near_goal(16, image_shape=(84, 84, 3)), synthetic.failed(16), r"near_goal.*\[16, 84, 84, 3\]"),
        (synthetic.near_goal(16), synthetic.failed(16, image_shape=(84, 84, 3)), r"failed.*\[16, 84, 84, 3\]"),
        (
            synthetic.near_goal(
                16, **dict(zip(("image_shape", "frame_stack"), synthetic.SHAPES["64x64x12"], strict=True))
            ),
            synthetic.failed(16),
            r"\[16, 64, 64, 12\]",
        ),
        (chw(synthetic.near_goal(16)), synthetic.failed(16), r"\[16, 3, 64, 64\].*channels come last"),
        (floats(synthetic.near_goal(16)), synthetic.failed(16), r"torch\.float32.*levels are 0 to 255"),
        (
            synthetic.near_goal(16),
            {"pixels": torch.zeros(0, 64, 64, 3, dtype=torch.uint8), "pose": torch.zeros(0, 3)},
            r"failed.*N at least 1",
        ),
        (
            synthetic.near_goal(16),
            synthetic.failed(16) | {"pose": torch.zeros(15, 3)},
            r"failed\['pose'\] is \[15, 3\]",
        ),
        (synthetic.near_goal(16, flagged=True), synthetic.failed(16), r"near_goal\['pose'\].*must hold 3 floats"),
    ],
)
def test_frames_that_are_not_the_generators_are_refused_at_the_door(
    near_goal: dict[str, Tensor], failed: dict[str, Tensor], message: str
) -> None:
    rng = torch.Generator()
    with pytest.raises(ValueError, match=message):
        MatteRegression(CoordinateGenerator(), near_goal=near_goal, failed=failed, rng=rng)


def test_a_missing_entry_is_named() -> None:
    with pytest.raises(KeyError, match="near_goal lacks 'goal_pose'"):
        fit(CoordinateGenerator(), synthetic.failed(16), synthetic.failed(16))


def test_flags_that_are_not_named_are_refused() -> None:
    with pytest.raises(ValueError, match=r"takes poses of 4 entries.*flags \(\) are 3"):
        fit(CoordinateGenerator(pose_size=4), synthetic.near_goal(16, flagged=True), synthetic.failed(16, flagged=True))


def test_a_generator_without_mattes_is_refused() -> None:
    with pytest.raises(ValueError, match="PaperGenerator has no mattes"):
        fit(PaperGenerator(), synthetic.near_goal(16), synthetic.failed(16))


def test_a_goal_without_a_colour_of_its_own_is_refused() -> None:
    data = synthetic.near_goal(16)
    with pytest.raises(ValueError, match="No colour is shown several times as often"):
        fit(CoordinateGenerator(), data | {"pixels": data["empty"]}, {"pixels": data["empty"], "pose": data["pose"]})


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
        config = MatteConfig(steps=150, batch_size=64, pixels=128, latent_noise=latent_noise)
        regression = MatteRegression(generator, near_goal=data, failed=failed, rng=rng, config=config)
        for _ in range(config.steps):
            regression.step()
        with torch.no_grad():
            matte = generator(generator.encoding(labels), generator.sample_latent(256, rng))
        return float(matte[:, 3].flatten(1).amax(1).mean())

    sharp, blurred = opacity(0.05), opacity(1.0)
    assert sharp > 1.3 * blurred


@pytest.mark.parametrize(
    "changes",
    [
        {"steps": -1},
        {"batch_size": 0},
        {"pixels": 0},
        {"learning_rate": 0.0},
        {"latent_noise": -0.1},
        {"latent_noise": 1.1},
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        MatteConfig(**changes)


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


def test_grey_levels_are_told_apart_finer_than_those_of_a_colour() -> None:
    levels = torch.tensor([[0], [3], [4], [255]], dtype=torch.uint8)
    assert colour_index(levels).tolist() == [0, 0, 1, 63]
