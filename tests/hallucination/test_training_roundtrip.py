"""A generator of any image shape, from its training through weights, bank, pipeline and buffer."""

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from halgan_rl.hallucination.bank import BankGrid, HallucinationBank
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.training.adversarial import AdversarialConfig
from halgan_rl.hallucination.training.matte_regression import MatteConfig
from halgan_rl.hallucination.training.paper import PaperTrainingConfig
from halgan_rl.hallucination.training.steps import LOSSES, GeneratorTraining, GeneratorTrainingConfig
from halgan_rl.hallucination.weights import load_generator, save_weights
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms import Annealing, pipelines
from halgan_rl.transforms.hindsight_config import HindsightConfig
from tests import synthetic


@pytest.mark.parametrize("shape", ["64x64x3", *synthetic.SHAPES])
def test_a_generator_of_any_shape_is_trained_saved_tabulated_and_paints_rows_of_a_buffer(
    shape: str, tmp_path: Path
) -> None:
    image_shape, frame_stack = synthetic.SHAPES.get(shape, (synthetic.RGB, 1))
    torch.manual_seed(0)
    generator = CoordinateGenerator(image_shape=image_shape, frame_stack=frame_stack)
    data = synthetic.near_goal(32, image_shape=image_shape, frame_stack=frame_stack)
    training = GeneratorTraining(
        generator,
        near_goal=data,
        failed=synthetic.failed(32, image_shape=image_shape, frame_stack=frame_stack),
        rng=torch.Generator().manual_seed(0),
        config=GeneratorTrainingConfig(
            MatteConfig(steps=60, batch_size=32, pixels=128),
            AdversarialConfig(steps=2, coarse=0.5, batch_size=2, learning_rate=1e-6, fine_learning_rate=1e-6),
            PaperTrainingConfig(
                steps=1, batch_size=2, critic_steps=1, generator_learning_rate=1e-6, discriminator_stride=2
            ),
        ),
    )
    losses: dict[str, float] = {}
    for _ in range(63):
        losses |= training.step()
    assert set(losses) == set(LOSSES)
    with pytest.raises(StopIteration):
        training.step()
    kept = training.average

    path = tmp_path / "generator.safetensors"
    save_weights(path, kept, {"kind": "coordinates", "arguments": kept.arguments})
    loaded = load_generator(path, fingerprint={}, poses=PlanarPoses(), image_shape=image_shape, frame_stack=frame_stack)
    grid = BankGrid(distances=9, bearings=9, latents=1)
    bank = HallucinationBank(loaded, grid, rng=torch.Generator().manual_seed(0))

    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(64),
        transform=pipelines.halgan(
            bank,
            rng=torch.Generator().manual_seed(0),
            config=HindsightConfig(probability=Annealing(1.0, 1.0, 1), max_distance=4),
        ),
        batch_size=32,
    )
    buffer.extend(drive(image_shape))
    batch = buffer.sample()
    painted = (batch["pixels"] != 100).flatten(1).any(1)
    relabelled = batch["goal", "mask"].squeeze(-1)
    assert batch["pixels"].shape == (32, *image_shape)
    assert relabelled.any()
    assert not (painted & ~relabelled).any()
    assert (painted & relabelled).any()


def drive(image_shape: tuple[int, int, int], steps: int = 24) -> TensorDict:
    """Returns an episode straight ahead over grey ground, without reward."""
    pose = torch.zeros(steps + 1, 3)
    pose[:, 0] = 0.1 * torch.arange(steps + 1)
    pixels = torch.full((steps, *image_shape), 100, dtype=torch.uint8)
    flag = torch.zeros(steps, 1, dtype=torch.bool)
    last = flag.clone()
    last[-1] = True
    following = {"pixels": pixels, "pose": pose[1:], "reward": torch.zeros(steps, 1)}
    following |= {"done": last, "terminated": flag, "truncated": last}
    return TensorDict(
        {"pixels": pixels, "pose": pose[:-1], "action": torch.zeros(steps, 2), "next": following}, batch_size=[steps]
    )
