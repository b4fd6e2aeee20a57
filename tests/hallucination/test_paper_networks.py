from typing import Any, Literal

import pytest
import torch
from torch import nn

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.training.paper_discriminator import Discriminator
from tests.synthetic import SHAPES

GENERATORS = [PaperGenerator, CoordinateGenerator]


def numbers(network: nn.Module) -> int:
    """Count parameters and BatchNorm's running statistics, as Keras does."""
    statistics = [tensor for name, tensor in network.named_buffers() if name.endswith(("running_mean", "running_var"))]
    return sum(tensor.numel() for tensor in [*network.parameters(), *statistics])


def test_generator_and_discriminator_are_counted_as_in_the_paper() -> None:
    assert numbers(PaperGenerator()) == 323_707
    assert numbers(Discriminator()) == 330_019
    assert numbers(Discriminator(first_stride=2)) == 330_019


def test_the_discriminator_judges_each_image_by_itself() -> None:
    discriminator = Discriminator(feature_size=4)
    images = torch.randn(3, 3, 64, 64)
    scores, features = discriminator(images)
    assert scores.shape == (3,)
    assert features.shape == (3, 4)
    torch.testing.assert_close(discriminator(images[1:2])[0], scores[1:2])


@pytest.mark.parametrize("build", GENERATORS)
def test_a_generator_answers_configuration_and_latent(build: type[HallucinationGenerator]) -> None:
    torch.manual_seed(0)
    generator = build().eval()
    rng = torch.Generator().manual_seed(0)
    features, latent = torch.randn(2, generator.encoding.size), generator.sample_latent(2, rng)
    change = generator(features, latent)
    assert change.shape[0] == 2
    assert change.shape[2:] == (64, 64)
    assert not torch.equal(generator(features.flip(0), latent), change)
    assert not torch.equal(generator(features, latent.flip(0)), change)
    composed = generator.compose(torch.zeros(2, 3, 64, 64), change)
    assert composed.shape == (2, 3, 64, 64)
    assert composed.abs().max() <= 1


@pytest.mark.parametrize("build", GENERATORS)
@pytest.mark.parametrize("shape", [*SHAPES, "48x80x2"])
def test_a_generator_paints_images_of_any_shape(build: type[HallucinationGenerator], shape: str) -> None:
    image_shape, frame_stack = SHAPES.get(shape, ((48, 80, 2), 2))
    generator = build(image_shape=image_shape, frame_stack=frame_stack).eval()
    height, width, channels = image_shape
    images = torch.zeros(2, channels, height, width)
    rng = torch.Generator().manual_seed(0)
    change = generator(torch.randn(2, generator.encoding.size), generator.sample_latent(2, rng))
    assert generator.compose(images, change).shape == images.shape
    assert (generator.image_shape, generator.frame_stack) == (image_shape, frame_stack)


@pytest.mark.parametrize("build", GENERATORS)
@pytest.mark.parametrize(
    ("shape", "frame_stack", "message"),
    [
        ((64, 64, 4), 1, "4 channels, but frame_stack=1 frames have 1 .grey. or 3"),
        ((64, 64, 12), 3, "12 channels, but frame_stack=3"),
        ((64, 64), 1, "height, width and channels"),
        ((3, 64, 64), 1, "64 channels"),
        ((0, 64, 3), 1, "height=0"),
        ((64, 64.0, 3), 1, "width=64.0"),
        ((64, 64, 3), 0, "frame_stack=0"),
    ],
)
def test_shapes_that_are_no_images_are_refused(
    build: Any, shape: tuple[Any, ...], frame_stack: int, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        build(image_shape=shape, frame_stack=frame_stack)


def test_each_frame_of_a_stack_is_painted_with_a_matte_of_its_own() -> None:
    generator = CoordinateGenerator(image_shape=(64, 64, 6), frame_stack=2)
    images, colours = torch.zeros(1, 6, 64, 64), torch.full((1, 6, 64, 64), 0.5)
    opacities = torch.stack([torch.zeros(64, 64), torch.ones(64, 64)])[None]
    composed = generator.compose(images, torch.cat([colours, opacities], 1))
    assert composed[0].amax((1, 2)).tolist() == [0, 0, 0, 0.5, 0.5, 0.5]


def test_u_runs_along_the_width_and_v_along_the_height() -> None:
    u, v, one = CoordinateGenerator(image_shape=(2, 4, 3)).coordinates.unbind(-1)
    assert u.tolist() == 2 * [-0.75, -0.25, 0.25, 0.75]
    assert v.tolist() == 4 * [-0.5] + 4 * [0.5]
    assert one.tolist() == 8 * [1]


@pytest.mark.parametrize(
    ("image_shape", "first_stride"), [((84, 84, 3), 1), ((84, 84, 3), 2), ((64, 128, 1), 1), ((130, 64, 12), 2)]
)
def test_the_discriminator_judges_images_of_any_shape_from_64_pixels_on(
    image_shape: tuple[int, int, int], first_stride: Literal[1, 2]
) -> None:
    height, width, channels = image_shape
    discriminator = Discriminator(4, image_shape=image_shape, first_stride=first_stride)
    scores, features = discriminator(torch.randn(2, channels, height, width))
    assert (scores.shape, features.shape) == ((2,), (2, 4))


def test_images_too_small_for_the_discriminator_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(48, 80, 3\) is too small.*at least 64"):
        Discriminator(image_shape=(48, 80, 3))


@pytest.mark.parametrize("build", GENERATORS)
def test_the_arguments_rebuild_a_generator(build: type[HallucinationGenerator]) -> None:
    generator = build(pose_size=4, latent_size=5)
    other = build(**generator.arguments)
    other.load_state_dict(generator.state_dict())
    rng = torch.Generator().manual_seed(0)
    inputs = torch.randn(2, generator.encoding.size), generator.sample_latent(2, rng)
    assert torch.equal(generator.eval()(*inputs), other.eval()(*inputs))


def test_an_opacity_of_0_keeps_the_image_bit_for_bit_and_1_replaces_it() -> None:
    images, colour = torch.rand(1, 3, 64, 64) * 2 - 1, torch.full((1, 3, 64, 64), 0.25)
    opacity = torch.zeros(1, 1, 64, 64)
    opacity[..., 32:] = 1
    composed = CoordinateGenerator().compose(images, torch.cat([colour, opacity], 1))
    assert torch.equal(composed[..., :32], images[..., :32])
    torch.testing.assert_close(composed[..., 32:], colour[..., 32:])


def test_only_the_papers_composition_dims_an_image_that_nothing_is_painted_into() -> None:
    images, nothing = torch.full((1, 3, 64, 64), 0.8), torch.zeros(1, 3, 64, 64)
    assert PaperGenerator(composition="dimming").compose(images, nothing).max() < 0.7
    assert torch.equal(PaperGenerator(composition="difference").compose(images, nothing), images)


def test_painting_by_coordinates_moves_with_its_half_planes() -> None:
    """Shifting all half-planes by 8 pixels shifts the matte by 8 pixels."""
    torch.manual_seed(0)
    generator = CoordinateGenerator(gain=1.0)
    inputs = torch.randn(1, 4), torch.randn(1, 2)
    matte = generator(*inputs)
    shifts = generator.place[-1]
    assert isinstance(shifts, nn.Linear)
    with torch.no_grad():  # a(u - 1/4) + b v + c, a quarter being 8 of 32 pixels
        width = generator.arguments["width"]
        for tensor in (shifts.weight, shifts.bias):
            tensor[2 * int(width) :] -= tensor[: int(width)] / 4
    torch.testing.assert_close(generator(*inputs)[..., 8:], matte[..., :-8])
