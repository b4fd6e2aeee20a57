import json
import warnings
from pathlib import Path

import pytest
import torch

from halgan_rl.agents.networks import Actor
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.weights import load_generator, load_module, save_weights, shipped_weights

HERE = {"environment": "navigate-2m", "mujoco": "3.17.0", "gl": "egl", "golden_frame": "abc"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Weights of a small generator whose encoding is no identity, with its manifest."""
    torch.manual_seed(0)
    generator = CoordinateGenerator(latent_size=3, width=8, depth=1)
    generator.encoding.standardise(torch.randn(20, 3))
    save_weights(
        tmp_path / "g.safetensors", generator, {"kind": "coordinates", "arguments": generator.arguments, **HERE}
    )
    return tmp_path / "g.safetensors"


def edit_manifest(path: Path, **changes: object) -> None:
    manifest_path = path.with_suffix(".json")
    manifest_path.write_text(json.dumps(json.loads(manifest_path.read_text()) | changes))


def test_a_generator_comes_back_bit_for_bit(path: Path) -> None:
    torch.manual_seed(0)
    original = CoordinateGenerator(latent_size=3, width=8, depth=1)
    original.encoding.standardise(torch.randn(20, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load_generator(path, expected=HERE)
    assert not loaded.training
    inputs = original.encoding(torch.ones(1, 3)), torch.ones(1, 3)
    assert torch.equal(loaded.encoding(torch.ones(1, 3)), inputs[0])
    assert torch.equal(loaded(*inputs), original(*inputs))


def test_the_papers_generator_keeps_its_running_statistics(tmp_path: Path) -> None:
    generator = PaperGenerator(latent_size=16)
    generator(torch.randn(4, 2), torch.randn(4, 16))
    save_weights(tmp_path / "p.safetensors", generator, {"kind": "paper", "arguments": generator.arguments, **HERE})
    loaded = load_generator(tmp_path / "p.safetensors", expected=HERE)
    inputs = torch.randn(2, 2), torch.randn(2, 16)
    assert torch.equal(loaded(*inputs), generator.eval()(*inputs))


def test_a_network_of_any_kind_is_rebuilt_from_its_arguments(tmp_path: Path) -> None:
    actor = Actor(3, downsample="max_pool")
    manifest = {"arguments": {"action_size": 3, "downsample": "max_pool"}, "note": 1}
    save_weights(tmp_path / "a.safetensors", actor, manifest)
    loaded, read = load_module(tmp_path / "a.safetensors", Actor)
    assert read == manifest
    pixels = torch.zeros(1, 64, 64, 3, dtype=torch.uint8)
    assert torch.equal(loaded(pixels), actor(pixels))


def test_a_second_save_replaces_the_first_and_leaves_nothing_behind(path: Path) -> None:
    generator = CoordinateGenerator(latent_size=3, width=8, depth=1)
    save_weights(path, generator, {"kind": "coordinates", "arguments": generator.arguments, **HERE})
    loaded = load_generator(path, expected=HERE)
    assert torch.equal(loaded.state_dict()["place.0.weight"], generator.state_dict()["place.0.weight"])
    assert sorted(file.name for file in path.parent.iterdir()) == ["g.json", "g.safetensors"]


@pytest.mark.parametrize(
    ("here", "message"),
    [
        ({"environment": "navigate-4m"}, r"'navigate-2m', not for 'navigate-4m'.*train_halgan"),
        ({"mujoco": "3.18.0"}, r"3\.17\.0, this is 3\.18\.0.*allow_other_mujoco"),
    ],
)
def test_weights_made_elsewhere_are_refused(path: Path, here: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_generator(path, expected=HERE | here)


def test_another_mujoco_can_be_allowed(path: Path) -> None:
    load_generator(path, expected=HERE | {"mujoco": "3.18.0"}, allow_other_mujoco=True)


def test_poses_of_another_size_are_refused(path: Path) -> None:
    with pytest.raises(ValueError, match="poses of 3 entries, not 4"):
        load_generator(path, expected=HERE, pose_size=4)


def test_another_golden_frame_is_only_warned_about(path: Path) -> None:
    with pytest.warns(UserWarning, match="OpenGL driver"):
        load_generator(path, expected=HERE | {"golden_frame": "def"})


def test_something_else_than_a_generator_is_refused(path: Path) -> None:
    edit_manifest(path, kind="actor")
    with pytest.raises(ValueError, match="'actor'"):
        load_generator(path, expected=HERE)


def test_missing_files_are_named(path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no weights at .*other\.safetensors"):
        load_generator(path.with_name("other.safetensors"), expected=HERE)
    path.with_suffix(".json").unlink()
    with pytest.raises(FileNotFoundError, match=r"lacks its manifest g\.json"):
        load_generator(path, expected=HERE)


def test_damaged_files_are_named(path: Path) -> None:
    edit_manifest(path, arguments={"latent_size": 3, "width": 9, "depth": 1, "pose_size": 3})
    with pytest.raises(ValueError, match="does not fit"):
        load_generator(path, expected=HERE)
    edit_manifest(path, arguments={"latent_size": 3, "width": 8, "depth": 1, "pose_size": 3})
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"g\.safetensors is damaged"):
        load_generator(path, expected=HERE)
    path.with_suffix(".json").write_text("{")
    with pytest.raises(ValueError, match=r"g\.json is damaged"):
        load_generator(path, expected=HERE)
    path.with_suffix(".json").write_text("{}")
    with pytest.raises(ValueError, match="lacks 'arguments'"):
        load_generator(path, expected=HERE)


def test_weights_that_are_not_shipped_are_said_to_be_missing() -> None:
    with pytest.raises(FileNotFoundError, match=r"'navigate-9m'.*train_halgan"):
        shipped_weights("navigate-9m")
