import math
from typing import Literal

import pytest
import torch
from torch import Tensor

from halgan_rl.hallucination.bank import BankGrid, HallucinationBank
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.poses import PlanarPoses, relative_pose
from tests.synthetic import SHAPES, vivid_generator

AT_POSE = PlanarPoses()
"""Goals stand where their goal poses are."""
AHEAD = PlanarPoses(goal_offsets=(0.2,))
SMALL = {"distances": 5, "bearings": 7, "yaws": 3, "latents": 2}


@pytest.fixture
def generator() -> CoordinateGenerator:
    return vivid_generator()


def random_source(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make(
    generator: CoordinateGenerator | PaperGenerator, *, seed: int = 0, poses: PlanarPoses = AT_POSE, **grid: object
) -> HallucinationBank:
    return HallucinationBank(generator, BankGrid(**(SMALL | grid)), poses=poses, rng=random_source(seed))  # type: ignore[arg-type]


def random_frames(*shape: int, image_shape: tuple[int, int, int] = (64, 64, 3)) -> Tensor:
    return torch.randint(0, 256, (*shape, *image_shape), generator=random_source(1)).to(torch.uint8)


@pytest.mark.parametrize("goal_offset", [0.0, 0.2])
@pytest.mark.parametrize("yaws", [1, 4])
def test_each_cell_is_nearest_to_its_own_centre(goal_offset: float, yaws: int) -> None:
    grid = BankGrid(distances=9, bearings=11, yaws=yaws, widest=0.9)
    poses = PlanarPoses(goal_offsets=(goal_offset,))
    cells, in_sight = grid.cells_at(torch.zeros(3), grid.relative_poses(goal_offset), poses)
    assert cells.tolist() == list(range(grid.cells)) == list(range(9 * 11 * yaws))
    inner = torch.arange(grid.cells).reshape(9, 11, yaws)[:, 1:-1].flatten()  # the outermost bearings may round away
    assert in_sight[inner].all()


def test_a_cell_depends_on_the_relative_pose_only() -> None:
    grid = BankGrid(distances=9, bearings=11, yaws=4, widest=0.9)
    relative = grid.relative_poses(0.2)
    yaw = torch.linspace(-9.0, 9.0, len(relative))
    pose = torch.stack([yaw.cos(), 2 * yaw.sin(), yaw], -1)
    x, y, turn = relative.unbind(-1)
    ahead, left = torch.stack([yaw.cos(), yaw.sin()], -1), torch.stack([-yaw.sin(), yaw.cos()], -1)
    goal = torch.cat([pose[:, :2] + x[:, None] * ahead + y[:, None] * left, (yaw + turn)[:, None]], -1)
    assert grid.cells_at(pose, goal, AHEAD)[0].tolist() == list(range(grid.cells))


def test_cells_are_spaced_by_bearing_and_inverse_distance_of_the_goal_itself() -> None:
    grid = BankGrid(nearest=0.2, farthest=2.0, widest=0.5, distances=10, bearings=3, yaws=2)
    x, y, yaw = grid.relative_poses(0.2).reshape(10, 3, 2, 3)[4, 2].unbind(-1)
    assert yaw.tolist() == pytest.approx([0, math.pi])
    goal = torch.stack([x + 0.2 * yaw.cos(), y + 0.2 * yaw.sin()], -1)
    distance = 1 / (5 - 4 * 0.5)
    for point in goal:
        assert point.tolist() == pytest.approx([distance * math.cos(0.5), distance * math.sin(0.5)], abs=1e-6)


def test_what_is_nearer_or_farther_than_the_grid_is_painted_at_its_edge() -> None:
    grid = BankGrid(distances=4, bearings=5)
    near, far = grid.cells_at(torch.zeros(3), torch.tensor([[1e-4, 0.0, 0.0], [99.0, 0.0, 0.0]]), AT_POSE)[0]
    ends = torch.tensor([[grid.nearest, 0.0, 0.0], [grid.farthest, 0.0, 0.0]])
    edges = grid.cells_at(torch.zeros(3), ends, AT_POSE)[0]
    assert [near, far] == edges.tolist()


@pytest.mark.parametrize("shape", ["64x64x3", *SHAPES])
def test_at_a_cell_the_bank_paints_what_the_generator_does(shape: str) -> None:
    image_shape, frame_stack = SHAPES.get(shape, ((64, 64, 3), 1))
    generator = vivid_generator(image_shape=image_shape, frame_stack=frame_stack)
    grid = BankGrid(**SMALL)  # type: ignore[arg-type]
    bank = HallucinationBank(generator, grid, rng=random_source())
    latents = generator.sample_latent(grid.latents, random_source())
    goals = grid.relative_poses(0.0).reshape(5, 7, 3, 3)[:, 1:-1].flatten(0, 2)[:, None]
    frames, poses = random_frames(len(goals), 1, image_shape=image_shape), torch.zeros(len(goals), 1, 3)
    seen = bank(frames, poses, goals)
    errors = []
    for latent in latents:
        generator.sample_latent = lambda count, rng, latent=latent: latent.expand(count, -1)  # type: ignore[method-assign, misc]
        exact = GeneratorHallucinator(generator, rng=random_source())(frames, poses, goals)
        errors.append((seen.int() - exact.int()).abs().flatten(1).amax(1))
    assert torch.stack(errors).amin(0).max() <= 4  # 8 bits of colour and opacity, and pixels too faint to keep
    assert all((error > 20).any() for error in errors)  # each latent has rows of its own
    assert ((seen != frames).flatten(2).float().mean(-1) > 0.1).any()


def test_frames_are_seen_from_their_own_pose_and_share_one_latent(generator: CoordinateGenerator) -> None:
    bank = make(generator, yaws=8)
    frames = random_frames(1, 1).expand(6, 2, -1, -1, -1)
    pose = torch.tensor([[0.3, 0.2, 0.4], [0.3, 0.2, 0.4]]).expand(6, 2, 3)
    goal = torch.tensor([[0.9, 0.4, 0.9]]).expand(6, 1, 3)
    same = bank(frames, pose, goal)
    assert torch.equal(same[:, 0], same[:, 1])
    assert len(torch.unique(same[:, 0], dim=0)) == 2  # rows are shown one of both latents each
    other = bank(frames, torch.stack([pose[:, 0], pose[:, 0] - torch.tensor([0.5, 0.0, 0.0])], 1), goal)
    assert not torch.equal(other[:, 0], other[:, 1])
    origin = bank(frames, torch.zeros(6, 2, 3), relative_pose(pose[:, :1], goal))
    assert {image.sum().item() for image in origin[:, 0]} == {image.sum().item() for image in same[:, 0]}


def test_frames_of_a_row_may_draw_latents_of_their_own(generator: CoordinateGenerator) -> None:
    grid = BankGrid(**SMALL)  # type: ignore[arg-type]
    bank = HallucinationBank(generator, grid, rng=random_source(), share_latent=False)
    frames = random_frames(1, 1).expand(6, 2, -1, -1, -1)
    painted = bank(frames, torch.zeros(6, 2, 3), torch.tensor([0.5, 0.0, 0.0]).expand(6, 1, 3))
    assert not torch.equal(painted[:, 0], painted[:, 1])
    assert len(torch.unique(painted.flatten(0, 1), dim=0)) == 2


def test_a_goal_out_of_sight_keeps_every_bit(generator: CoordinateGenerator) -> None:
    frames = random_frames(3, 1)
    behind = torch.tensor([[[-1.0, 0.1, 0.0]], [[0.0, 1.0, 0.0]], [[1.0, -1.1, 0.0]]])
    assert torch.equal(make(generator)(frames, torch.zeros(3, 1, 3), behind), frames)


def test_given_frames_stay(generator: CoordinateGenerator) -> None:
    frames = random_frames(4, 2)
    before = frames.clone()
    painted = make(generator)(frames, torch.zeros(4, 2, 3), torch.tensor([0.5, 0.0, 0.0]).expand(4, 1, 3))
    assert torch.equal(frames, before)
    assert not torch.equal(painted, before)


def test_flags_of_the_pose_choose_what_is_painted() -> None:
    bank = make(vivid_generator(pose_size=4), latents=1, poses=PlanarPoses(flags=("held",)))
    frames = random_frames(1, 1).expand(2, 1, -1, -1, -1)
    pose = torch.tensor([[[0.0, 0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]]])
    painted = bank(frames, pose, torch.tensor([[0.5, 0.0, 0.0, 1.0]]).expand(2, 1, 4))
    assert not torch.equal(painted[0], painted[1])


def test_each_setting_of_the_flags_has_an_offset_of_its_own() -> None:
    generator, offsets = vivid_generator(pose_size=4), (0.0, 0.3)
    bank = make(generator, latents=1, yaws=1, poses=PlanarPoses(flags=("held",), goal_offsets=offsets))
    frames = random_frames(1, 1)
    for flag, offset in enumerate(offsets):
        pose, straight = torch.tensor([[[0.0, 0.0, 0.0, flag]]]), torch.tensor([[[0.5, 0.0, 0.0, flag]]])
        turned = torch.tensor([[[0.5 + offset, -offset, math.pi / 2, flag]]])  # about a goal that far ahead of it
        assert torch.equal(bank(frames, pose, straight), bank(frames, pose, turned))


def test_the_same_seed_gives_the_same_images(generator: CoordinateGenerator) -> None:
    frames, goals = random_frames(8, 2), torch.tensor([0.5, 0.1, 0.2]).expand(8, 1, 3)
    first, again, other = (make(generator, seed=seed)(frames, torch.zeros(8, 2, 3), goals) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_no_rows_are_no_trouble(generator: CoordinateGenerator) -> None:
    assert make(generator)(random_frames(0, 2), torch.zeros(0, 2, 3), torch.zeros(0, 1, 3)).shape == (0, 2, 64, 64, 3)


@pytest.mark.parametrize("training", [True, False])
def test_the_generator_keeps_its_mode(generator: CoordinateGenerator, training: bool) -> None:
    make(generator.train(training))
    assert generator.training == training


@pytest.mark.parametrize("composition", ["dimming", "difference"])
def test_a_generator_that_lays_no_matte_is_refused(composition: Literal["dimming", "difference"]) -> None:
    generator = PaperGenerator(composition=composition).train()
    with torch.no_grad():
        generator.layers[-2].bias.fill_(0.5)  # type: ignore[union-attr, operator]
    with pytest.raises(ValueError, match=r"PaperGenerator does not lay a matte.*CoordinateGenerator.*no-bank"):
        make(generator)
    assert generator.training


def test_flags_that_the_generator_does_not_know_are_refused_before_anything_is_tabulated(
    generator: CoordinateGenerator,
) -> None:
    with pytest.raises(ValueError, match=r"takes poses of 3 entries.*\('held',\) are 4"):
        make(generator, poses=PlanarPoses(flags=("held",)))


@pytest.mark.parametrize("shape", [(2, 2, 64, 64, 12), (2, 2, 3, 64, 64), (2, 2, 84, 84, 3), (2, 64, 64, 3)])
def test_images_of_another_shape_are_refused(generator: CoordinateGenerator, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=rf"pixels are torch.uint8 \{list(shape)}.*\[N, F, 64, 64, 3\]"):
        make(generator)(torch.zeros(shape, dtype=torch.uint8), torch.zeros(2, 2, 3), torch.zeros(2, 1, 3))


def test_float_images_are_refused(generator: CoordinateGenerator) -> None:
    with pytest.raises(ValueError, match=r"pixels are torch\.float32"):
        make(generator)(torch.zeros(2, 2, 64, 64, 3), torch.zeros(2, 2, 3), torch.zeros(2, 1, 3))


def test_the_bank_has_the_image_shape_of_its_generator() -> None:
    assert make(vivid_generator(image_shape=(48, 32, 2), frame_stack=2)).image_shape == (48, 32, 2)


def test_poses_of_another_size_or_not_finite_are_refused(generator: CoordinateGenerator) -> None:
    bank, frames = make(generator), random_frames(2, 2)
    with pytest.raises(ValueError, match="4 entries, but the generator was trained with 3"):
        bank(frames, torch.zeros(2, 2, 4), torch.zeros(2, 1, 3))
    with pytest.raises(ValueError, match="pose holds NaN"):
        bank(frames, torch.full((2, 2, 3), float("nan")), torch.zeros(2, 1, 3))


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ({"nearest": 0.0}, "0 < nearest"),
        ({"nearest": 2.0, "farthest": 1.0}, "2.0 and 1.0"),
        ({"widest": 4.0}, "widest=4.0"),
        ({"distances": 1}, "at least 2 distances"),
        ({"latents": 0}, "1 latent"),
    ],
)
def test_grids_that_make_no_sense_are_refused(grid: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BankGrid(**grid)  # type: ignore[arg-type]
