"""Adversarial training: the critic knows the pose, backgrounds match, coarse images come first, and goals appear."""

from copy import deepcopy
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.judging.fidelity import compare
from halgan_rl.hallucination.training.adversarial import AdversarialConfig, AdversarialTrainer
from halgan_rl.hallucination.training.critic import PoseCritic
from halgan_rl.hallucination.training.matching import nearest_backgrounds
from halgan_rl.poses import PlanarPoses
from tests import synthetic

SMALL = AdversarialConfig(steps=4, coarse=0.5, batch_size=4, penalty_interval=2)
HELD = PlanarPoses(flags=("held",))


def make_trainer(
    config: AdversarialConfig = SMALL,
    seed: int = 0,
    *,
    kind: type[HallucinationGenerator] = CoordinateGenerator,
    count: int = 16,
    flagged: bool = False,
    mirror: bool = True,
    **shape: Any,
) -> AdversarialTrainer:
    torch.manual_seed(0)
    data = synthetic.near_goal(count, flagged=flagged, **shape)
    generator = kind(pose_size=data["pose"].shape[1], **shape)
    generator.encoding.standardise(generator.encoding.labels(data["pose"], data["goal_pose"]))
    return AdversarialTrainer(
        generator,
        near_goal=data,
        failed=synthetic.failed(count, flagged=flagged, **shape),
        config=config,
        rng=torch.Generator().manual_seed(seed),
        poses=HELD if flagged else PlanarPoses(),
        mirror=mirror,
    )


def copy(network: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}


@pytest.mark.parametrize("kind", [CoordinateGenerator, PaperGenerator])
@pytest.mark.parametrize("shape", ["64x64x3", *synthetic.SHAPES])
def test_coarse_and_fine_steps_change_both_networks_whatever_the_shape_of_images(
    kind: type[HallucinationGenerator], shape: str
) -> None:
    image_shape, frame_stack = synthetic.SHAPES.get(shape, (synthetic.RGB, 1))
    trainer = make_trainer(kind=kind, image_shape=image_shape, frame_stack=frame_stack)
    before = {name: copy(network) for name, network in trainer.networks().items()}
    for coarse in (True, True, False, False):
        if not coarse:
            before["critic"] = copy(trainer.critic)
        metrics = trainer.step()
        assert metrics["critic_gap"].isfinite()
    for name, old in before.items():
        new = trainer.networks()[name].state_dict()
        unchanged = [key for key in old if torch.equal(old[key], new[key]) and not key.startswith("encoding")]
        # The score's constant cancels in differences; a convolution's does in front of BatchNorm.
        assert all(key == "realism.bias" or (kind is PaperGenerator and "bias" in key) for key in unchanged), name


def test_whole_images_are_scored_at_first_as_their_averages_are() -> None:
    torch.manual_seed(0)
    critic = PoseCritic(4)
    images, features = torch.rand(3, 3, 64, 64), torch.randn(3, 4)
    coarse = critic.score(critic.look(nn.functional.avg_pool2d(images, 2), coarse=True), features)
    torch.testing.assert_close(critic.score(critic.look(images, coarse=False), features), coarse)


def test_the_critics_score_depends_on_where_the_goal_should_be() -> None:
    torch.manual_seed(0)
    critic = PoseCritic(4)
    seen = critic.look(torch.rand(2, 3, 64, 64), coarse=False)
    one, other = critic.score(seen, torch.zeros(2, 4)), critic.score(seen, torch.ones(2, 4))
    assert (one - other).abs().min() > 1e-4


@pytest.mark.parametrize("image_shape", [(15, 64, 3), (64, 8, 3)])
def test_images_too_small_for_the_critic_are_refused(image_shape: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="at least 16 pixels"):
        PoseCritic(4, image_shape=image_shape)


def test_learning_rates_fall_in_the_second_half_of_each_resolution() -> None:
    config = AdversarialConfig(steps=100, coarse=0.6, learning_rate=1.0, fine_learning_rate=0.5)
    rates = [config.rate_at(step) for step in range(100)]
    assert rates[:31] == [1.0] * 31
    assert rates[60:81] == [0.5] * 21
    assert all(later < earlier for earlier, later in [*pairwise(rates[30:60]), *pairwise(rates[80:])])
    assert 0 < rates[-1] < 0.05
    assert AdversarialConfig(steps=10, coarse=1.0).rate_at(9) > 0
    assert AdversarialConfig(steps=10, coarse=0.0).rate_at(0) == AdversarialConfig().fine_learning_rate


def test_backgrounds_are_the_nearest_failed_frames_with_the_same_flags() -> None:
    near = {"pose": torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 3.1, 0.0], [1.0, 0.0, 0.0, 1.0]])}
    failed = {
        "pose": torch.tensor([[0.1, 0.0, 0.0, 0.0], [0.0, 0.0, -3.1, 0.0], [1.0, 0.0, 0.0, 0.0], [5.0, 0.0, 0.0, 1.0]])
    }
    rows = nearest_backgrounds(near, failed, HELD, count=2)
    assert rows[0].tolist() == [0, 1]  # nearer, and turned alike
    assert rows[1].tolist() == [1, 0]  # yaw wraps around
    assert rows[2].tolist() == [3, 3]  # the only one with that flag
    with pytest.raises(ValueError, match=r"flags \[1\.0\].*no failed ones"):
        nearest_backgrounds(near, {"pose": failed["pose"][:3]}, HELD, count=2)


def test_real_images_backgrounds_and_configurations_are_mirrored_alike() -> None:
    """A bright left half goes with a goal to the left, also in the mirror."""
    trainer = make_trainer(AdversarialConfig(batch_size=32, label_noise=(0.0, 0.0)))
    for name in ("_real_pixels", "_failed_pixels"):
        pixels = torch.zeros_like(getattr(trainer, name))
        pixels[:, :, :32] = 255
        setattr(trainer, name, pixels)
    trainer._labels = torch.tensor([[1.0, 0.5, 0.2]]).expand(16, -1)
    real, background, features, _ = trainer._draw(coarse=True)
    assert real.shape == background.shape == (32, 3, 32, 32)
    left_is_bright = real[:, 0, 0, 0] > 0
    assert 0 < left_is_bright.sum() < 32
    assert torch.equal(background[:, 0, 0, 0] > 0, left_is_bright)
    assert torch.equal(features[:, 1] > features[:, 1].mean(), left_is_bright)


def test_wrong_configurations_are_anothers_with_the_same_flags() -> None:
    trainer = make_trainer(AdversarialConfig(batch_size=16, label_noise=(0.0, 0.0)), flagged=True, mirror=False)
    _, _, features, wrong = trainer._draw(coarse=True)
    assert torch.equal(features[:, 4], wrong[:, 4])
    assert torch.equal(wrong[:, :4], features.roll(1, 0)[:, :4])
    assert not torch.equal(wrong[:, :4], features[:, :4])


def test_fakes_show_the_goal_that_is_pursued_in_their_failed_frame() -> None:
    """Failed frames with a red bar below have a flag of 1, and so have the configurations painted into them."""
    trainer = make_trainer(AdversarialConfig(batch_size=32, label_noise=(0.0, 0.0)), flagged=True, mirror=False)
    _, background, features, _ = trainer._draw(coarse=False)
    red_below = background[:, 0, 60, 0] > background[:, 1, 60, 0] + 0.5
    assert 0 < red_below.sum() < 32
    assert torch.equal(features[:, 4] > 0, red_below)


@pytest.mark.parametrize("kind", [CoordinateGenerator, PaperGenerator])
def test_a_change_of_nothing_has_no_extent_and_a_weight_on_it_makes_changes_smaller(
    kind: type[HallucinationGenerator],
) -> None:
    generator = kind()
    shape = generator(torch.zeros(2, generator.encoding.size), torch.zeros(2, generator.latent_size)).shape
    nothing, something = torch.zeros(shape), torch.full(shape, 0.5)
    assert generator.extent(nothing).tolist() == [0, 0]
    assert generator.extent(something).tolist() == [0.5, 0.5]
    extents = []
    for weight in (0.0, 1000.0):
        trainer = make_trainer(AdversarialConfig(steps=20, coarse=1.0, batch_size=4, extent_weight=weight), kind=kind)
        extents.append([float(trainer.step()["extent"]) for _ in range(20)])
    assert extents[1][-1] < 0.8 * extents[0][-1]


def test_what_is_painted_behind_shrinks_although_no_near_goal_frame_has_goals_there() -> None:
    """All goals of the data lie ahead. A generator that paints all over is to stop that behind."""
    behind = torch.tensor([[-1.0, 0.0, 0.0], [-0.5, 0.5, 1.0]])
    extents = {}
    for elsewhere in (0, 8):
        config = AdversarialConfig(steps=40, coarse=1.0, batch_size=4, extent_weight=100.0, elsewhere=elsewhere)
        trainer = make_trainer(config)
        with torch.no_grad():
            list(trainer.generator.paint)[-1].bias[3:] = 0.0
        for _ in range(40):
            trainer.step()
        features = trainer.generator.encoding(behind)
        with torch.no_grad():
            change = trainer.generator(features, torch.zeros(2, trainer.generator.latent_size))
        extents[elsewhere] = float(trainer.generator.extent(change).mean())
    assert extents[8] < 0.9 * extents[0]


def test_the_slope_is_penalised_at_its_interval() -> None:
    trainer = make_trainer()
    assert ["slope" in trainer.step() for _ in range(4)] == [True, False, True, False]


def test_the_average_follows_closely_at_first_and_lags_later() -> None:
    trainer = make_trainer(AdversarialConfig(steps=50, coarse=1.0, batch_size=2, average_decay=0.5))
    before = copy(trainer.generator)["paint.0.weight"]
    trainer.step()
    average, now = (copy(net)["paint.0.weight"] for net in (trainer.average, trainer.generator))
    torch.testing.assert_close(average, torch.lerp(before, now, 1 - 2 / 11))


def test_equal_seeds_give_equal_weights_and_other_seeds_do_not() -> None:
    trainers = [make_trainer(seed=seed) for seed in (0, 0, 1)]
    for trainer in trainers:
        for _ in range(3):
            trainer.step()
    one, same, other = (copy(trainer.average)["paint.0.weight"] for trainer in trainers)
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize("broken", [None, "rng", "steps", "critic", "optimizers", "average"])
def test_a_trainer_goes_on_from_its_state_bit_for_bit_and_needs_all_of_it(broken: str | None) -> None:
    whole, first, second = (make_trainer() for _ in range(3))
    for _ in range(4):
        whole.step()
    for _ in range(2):
        first.step()
    state = deepcopy(first.state_dict())
    if broken:
        state[broken] = deepcopy(make_trainer(seed=5).state_dict()[broken])
    second.load_state_dict(state)
    for _ in range(2):
        second.step()
    equal = [torch.equal(copy(whole.average)[name], value) for name, value in copy(second.average).items()]
    assert all(equal) == (broken is None)


@pytest.mark.parametrize(
    "changes",
    [
        {"batch_size": 1},
        {"penalty_interval": 0},
        {"steps": -1},
        {"coarse": 1.5},
        {"backgrounds": -1},
        {"learning_rate": 0.0},
        {"extent_weight": -0.1},
        {"elsewhere": -1},
        {"average_decay": -0.1},
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        AdversarialConfig(**changes)


def test_frames_of_another_shape_than_the_generators_are_refused_before_training() -> None:
    with pytest.raises(ValueError, match=r"near_goal\['pixels'\] is torch.uint8 \[16, 84, 84, 3\].*\[N, 64, 64, 3\]"):
        AdversarialTrainer(
            CoordinateGenerator(),
            near_goal=synthetic.near_goal(16, image_shape=(84, 84, 3)),
            failed=synthetic.failed(16),
            config=SMALL,
            rng=torch.Generator(),
        )


@pytest.mark.slow
def test_goals_appear_where_they_truly_are() -> None:
    trainer = make_trainer(AdversarialConfig(steps=500, coarse=1.0, batch_size=16), count=512)
    for _ in range(500):
        trainer.step()
    held_out = synthetic.near_goal(32, seed=7)
    paint = GeneratorHallucinator(trainer.average, rng=torch.Generator().manual_seed(0))
    rows = (held_out[name].unsqueeze(1) for name in ("empty", "pose", "goal_pose"))
    assert compare(held_out["empty"], held_out["pixels"], paint(*rows).squeeze(1)).mask_overlap > 0.4
