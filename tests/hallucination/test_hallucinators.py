import pytest
import torch
from torch import Tensor

from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator, RandomFlags
from halgan_rl.poses import PlanarPoses
from tests.synthetic import SHAPES, vivid_generator

ROWS, FRAMES = 3, 2


@pytest.fixture
def generator() -> CoordinateGenerator:
    return vivid_generator()


@pytest.fixture
def rows() -> tuple[Tensor, Tensor, Tensor]:
    rng = torch.Generator().manual_seed(1)
    pixels = torch.randint(0, 256, (ROWS, FRAMES, 64, 64, 3), generator=rng).to(torch.uint8)
    return pixels, torch.rand(ROWS, FRAMES, 3, generator=rng), torch.rand(ROWS, 1, 3, generator=rng)


def hallucinator(
    generator: CoordinateGenerator | PaperGenerator, *, share_latent: bool = True, chunk: int = 4
) -> GeneratorHallucinator:
    return GeneratorHallucinator(
        generator, rng=torch.Generator().manual_seed(2), share_latent=share_latent, chunk=chunk
    )


def test_every_frame_is_painted_and_the_given_ones_stay(
    generator: CoordinateGenerator, rows: tuple[Tensor, ...]
) -> None:
    before = rows[0].clone()
    painted = hallucinator(generator)(*rows)
    assert painted.shape == before.shape
    assert painted.dtype == torch.uint8
    assert torch.equal(rows[0], before)
    assert ((painted != before).flatten(2).float().mean(-1) > 0.1).all()


def test_chunks_change_nothing(generator: CoordinateGenerator, rows: tuple[Tensor, ...]) -> None:
    one, all_ = (hallucinator(generator, chunk=chunk)(*rows).int() for chunk in (1, 100))
    assert (one - all_).abs().max() <= 1


def test_frames_of_a_row_share_one_latent_and_rows_do_not(generator: CoordinateGenerator) -> None:
    pixels = torch.zeros(ROWS, FRAMES, 64, 64, 3, dtype=torch.uint8)
    painted = hallucinator(generator)(pixels, torch.zeros(ROWS, FRAMES, 3), torch.ones(ROWS, 1, 3))
    assert torch.equal(painted[:, 0], painted[:, 1])
    assert not torch.equal(painted[0], painted[1])


def test_frames_of_a_row_differ_if_they_share_no_latent(generator: CoordinateGenerator) -> None:
    pixels = torch.zeros(ROWS, FRAMES, 64, 64, 3, dtype=torch.uint8)
    painted = hallucinator(generator, share_latent=False)(pixels, torch.zeros(ROWS, FRAMES, 3), torch.ones(ROWS, 1, 3))
    assert len(torch.unique(painted.flatten(0, 1), dim=0)) == ROWS * FRAMES


def test_each_frame_shows_the_goal_as_seen_from_its_own_pose(generator: CoordinateGenerator) -> None:
    pixels = torch.zeros(1, FRAMES, 64, 64, 3, dtype=torch.uint8)
    pose = torch.tensor([[[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]])
    painted = hallucinator(generator)(pixels, pose, torch.tensor([[[1.0, 0.0, 0.0]]]))
    swapped = hallucinator(generator)(pixels, pose.flip(1), torch.tensor([[[1.0, 0.0, 0.0]]]))
    assert not torch.equal(painted[:, 0], painted[:, 1])
    assert (painted.int() - swapped.flip(1).int()).abs().max() <= 1


def test_random_flags_replace_those_of_the_poses_alike_in_all_images_of_a_row() -> None:
    seen: list[Tensor] = []

    def spy(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        seen.append(pose)
        return pixels

    pose = torch.rand(64, 2, 4)
    pose[..., 3] = 1
    painter = RandomFlags(spy, poses=PlanarPoses(flags=("held",)), rng=torch.Generator().manual_seed(0))
    painter(torch.zeros(64, 2, 1, 1, 3), pose, pose[:, :1])
    assert (pose[..., 3] == 1).all()
    assert torch.equal(seen[0][..., :3], pose[..., :3])
    flags = seen[0][..., 3]
    assert torch.equal(flags[:, 0], flags[:, 1])
    assert 20 < flags[:, 0].sum() < 44


def test_an_opacity_of_0_keeps_every_bit(rows: tuple[Tensor, ...]) -> None:
    generator = CoordinateGenerator()
    with torch.no_grad():
        generator.paint[-1].weight[3] = 0  # type: ignore[index, operator]
        generator.paint[-1].bias[3] = -100  # type: ignore[index, operator]
    assert torch.equal(hallucinator(generator)(*rows), rows[0])


@pytest.mark.parametrize("training", [True, False])
def test_the_networks_mode_is_found_again_but_never_used(rows: tuple[Tensor, ...], training: bool) -> None:
    torch.manual_seed(0)
    generator = PaperGenerator().train(training)
    state = {name: tensor.clone() for name, tensor in generator.state_dict().items()}
    first, second = (hallucinator(generator)(*rows) for _ in range(2))
    assert generator.training == training
    assert torch.equal(first, second)
    for name, tensor in generator.state_dict().items():
        assert torch.equal(tensor, state[name]), name
    assert not first.requires_grad


@pytest.mark.parametrize("shape", SHAPES)
def test_images_of_any_shape_are_painted(shape: str) -> None:
    image_shape, frame_stack = SHAPES[shape]
    painter = hallucinator(vivid_generator(image_shape=image_shape, frame_stack=frame_stack))
    pixels = torch.zeros(ROWS, FRAMES, *image_shape, dtype=torch.uint8)
    painted = painter(pixels, torch.zeros(ROWS, FRAMES, 3), torch.ones(ROWS, 1, 3))
    assert painted.shape == pixels.shape
    assert painter.image_shape == image_shape


@pytest.mark.parametrize("shape", [(3, 64, 64), (84, 84, 3), (64, 64, 12)])
def test_images_of_another_shape_than_the_generators_are_refused(
    generator: CoordinateGenerator, shape: tuple[int, int, int]
) -> None:
    pixels = torch.zeros(ROWS, FRAMES, *shape, dtype=torch.uint8)
    with pytest.raises(ValueError, match=rf"pixels are torch.uint8 \{list(pixels.shape)}.*\[N, F, 64, 64, 3\]"):
        hallucinator(generator)(pixels, torch.zeros(ROWS, FRAMES, 3), torch.ones(ROWS, 1, 3))


def test_float_images_are_refused(generator: CoordinateGenerator) -> None:
    pixels = torch.zeros(ROWS, FRAMES, 64, 64, 3)
    with pytest.raises(ValueError, match=r"pixels are torch\.float32"):
        hallucinator(generator)(pixels, torch.zeros(ROWS, FRAMES, 3), torch.ones(ROWS, 1, 3))


def test_random_flags_paint_the_images_of_their_hallucinator(generator: CoordinateGenerator) -> None:
    rng = torch.Generator()
    assert RandomFlags(hallucinator(generator), poses=PlanarPoses(), rng=rng).image_shape == (64, 64, 3)
    assert RandomFlags(lambda pixels, pose, goal: pixels, poses=PlanarPoses(), rng=rng).image_shape is None


def test_no_rows_are_no_trouble(generator: CoordinateGenerator, rows: tuple[Tensor, ...]) -> None:
    assert hallucinator(generator)(*(entry[:0] for entry in rows)).shape == (0, FRAMES, 64, 64, 3)


def test_poses_of_another_size_or_not_finite_are_refused(
    generator: CoordinateGenerator, rows: tuple[Tensor, ...]
) -> None:
    pixels, pose, goal_pose = rows
    with pytest.raises(ValueError, match="4 entries, but the generator was trained with 3"):
        hallucinator(generator)(pixels, torch.zeros(ROWS, FRAMES, 4), goal_pose)
    for strange in (float("nan"), float("inf"), -float("inf")):
        goal_pose[1, 0, 2] = strange
        with pytest.raises(ValueError, match="goal_pose holds NaN or infinity"):
            hallucinator(generator)(pixels, pose, goal_pose)
    goal_pose[:] = 3e38  # far, but finite
    hallucinator(generator)(pixels, pose, goal_pose)
