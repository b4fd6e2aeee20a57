import json
import re
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from halgan_rl.hallucination import weights
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.weights import load_generator, load_module, save_weights, shipped_weights
from halgan_rl.poses import PlanarPoses

PLAIN, FLAGGED = PlanarPoses(), PlanarPoses(flags=("held",))
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
        loaded = load_generator(path, fingerprint=HERE, poses=PLAIN)
    assert not loaded.training
    inputs = original.encoding(torch.ones(1, 3)), torch.ones(1, 3)
    assert torch.equal(loaded.encoding(torch.ones(1, 3)), inputs[0])
    assert torch.equal(loaded(*inputs), original(*inputs))


def test_the_papers_generator_keeps_its_running_statistics(tmp_path: Path) -> None:
    generator = PaperGenerator(latent_size=16)
    generator(torch.randn(4, 2), torch.randn(4, 16))
    save_weights(tmp_path / "p.safetensors", generator, {"kind": "paper", "arguments": generator.arguments, **HERE})
    loaded = load_generator(tmp_path / "p.safetensors", fingerprint=HERE, poses=PLAIN)
    inputs = torch.randn(2, 2), torch.randn(2, 16)
    assert torch.equal(loaded(*inputs), generator.eval()(*inputs))


def test_a_network_of_any_kind_is_rebuilt_from_its_arguments(tmp_path: Path) -> None:
    network = nn.Linear(3, 2, bias=False)
    manifest = {"arguments": {"in_features": 3, "out_features": 2, "bias": False}, "note": 1}
    save_weights(tmp_path / "a.safetensors", network, manifest)
    loaded, read = load_module(tmp_path / "a.safetensors", nn.Linear)
    assert read == manifest
    assert torch.equal(loaded(torch.ones(1, 3)), network(torch.ones(1, 3)))


def test_a_second_save_replaces_the_first_and_leaves_nothing_behind(path: Path) -> None:
    generator = CoordinateGenerator(latent_size=3, width=8, depth=1)
    save_weights(path, generator, {"kind": "coordinates", "arguments": generator.arguments, **HERE})
    loaded = load_generator(path, fingerprint=HERE, poses=PLAIN)
    assert torch.equal(loaded.state_dict()["place.0.weight"], generator.state_dict()["place.0.weight"])
    assert sorted(file.name for file in path.parent.iterdir()) == ["g.json", "g.safetensors"]


def refuse_to_build(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets a test fail that builds a network."""

    def build(*_: object) -> None:
        raise AssertionError("a network was built")

    monkeypatch.setattr(weights, "_rebuild", build)


@pytest.mark.parametrize(
    ("here", "message"),
    [
        (
            {"environment": "navigate-4m"},
            r"g\.json: 'environment' is 'navigate-2m', but here.*'navigate-4m'.*train_gen",
        ),
        ({"mujoco": "3.18.0"}, r"g\.json: 'mujoco' is '3\.17\.0', but here it is '3\.18\.0'.*allow_other_mujoco"),
        ({"camera": "wide"}, r"g\.json lacks 'camera', here 'wide'"),
    ],
)
def test_weights_made_elsewhere_are_refused_before_anything_is_built(
    path: Path, here: dict[str, str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_to_build(monkeypatch)
    with pytest.raises(ValueError, match=message):
        load_generator(path, fingerprint=HERE | here, poses=PLAIN)


def test_another_mujoco_can_be_allowed(path: Path) -> None:
    load_generator(path, fingerprint=HERE | {"mujoco": "3.18.0"}, poses=PLAIN, allow_other_mujoco=True)


@pytest.mark.parametrize("here", [{}, {"environment": "navigate-2m"}])
def test_only_what_the_fingerprint_has_is_compared(path: Path, here: dict[str, str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_generator(path, fingerprint=here, poses=PLAIN)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poses": FLAGGED}, r"g\.json: 'pose_size' is 3, but here it is 4"),
        ({"image_shape": (84, 84, 3)}, r"g\.json: 'image_shape' is \[64, 64, 3\], but here it is \[84, 84, 3\]"),
        ({"frame_stack": 3}, r"g\.json: 'frame_stack' is 1, but here it is 3"),
        ({"image_shape": (3, 64, 64)}, r"\(3, 64, 64\) has 64 channels"),
    ],
)
def test_images_and_poses_of_another_shape_are_refused_before_anything_is_built(
    path: Path, options: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_to_build(monkeypatch)
    with pytest.raises(ValueError, match=message):
        load_generator(path, fingerprint=HERE, **({"poses": PLAIN} | options))


def test_another_golden_frame_is_only_warned_about(path: Path) -> None:
    with pytest.warns(UserWarning, match="OpenGL driver"):
        load_generator(path, fingerprint=HERE | {"golden_frame": "def"}, poses=PLAIN)


@pytest.mark.parametrize("kind", ["actor", None, ["coordinates"], 3])
def test_something_else_than_a_generator_is_refused(path: Path, kind: object) -> None:
    edit_manifest(path, kind=kind)
    with pytest.raises(ValueError, match=rf"g\.json: 'kind' is {re.escape(repr(kind))}, no generator's"):
        load_generator(path, fingerprint=HERE, poses=PLAIN)


@pytest.mark.parametrize("field", list(HERE))
def test_a_manifest_without_a_field_of_the_fingerprint_is_refused(path: Path, field: str) -> None:
    """Only the backend is not compared: the golden frame shows its effect."""
    manifest = json.loads(path.with_suffix(".json").read_text())
    del manifest[field]
    path.with_suffix(".json").write_text(json.dumps(manifest))
    if field == "gl":
        load_generator(path, fingerprint=HERE, poses=PLAIN)
        return
    with pytest.raises(ValueError, match=rf"g\.json lacks '{field}'.*train_generator"):
        load_generator(path, fingerprint=HERE, poses=PLAIN)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": None}, r"g\.json lacks 'width' in its 'arguments'"),
        ({"colour": "red"}, r"g\.json has the unknown 'colour' in its 'arguments'"),
        ({"width": 10**9}, r"g\.json has 'arguments'.*width=1000000000 must be a whole number from 1 to 1024"),
        ({"depth": "2"}, r"g\.json.*depth='2'"),
        ({"latent_size": 0}, r"g\.json.*latent_size=0"),
        ({"opacity": 1.0}, r"g\.json.*opacity=1.0"),
        ({"gain": [10.0]}, r"g\.json.*gain=\[10.0\]"),
        ({"configuration": ["planar"]}, r"g\.json.*configuration=\['planar'\]"),
        ({"pose_size": "3"}, r"g\.json: 'pose_size' is '3', but here it is 3"),
        ({"image_shape": "64x64"}, r"g\.json: 'image_shape' is '64x64', but here"),
        ({"image_shape": [64.0, 64, 3]}, r"g\.json.*height=64.0"),
        ({"frame_stack": True}, r"g\.json.*frame_stack=True"),
    ],
)
def test_an_argument_that_is_missing_or_makes_no_sense_is_named(
    path: Path, changes: dict[str, Any], message: str
) -> None:
    arguments = json.loads(path.with_suffix(".json").read_text())["arguments"] | changes
    edit_manifest(path, arguments={name: value for name, value in arguments.items() if value is not None})
    with pytest.raises(ValueError, match=message):
        load_generator(path, fingerprint=HERE, poses=PLAIN)


def test_missing_files_are_named(path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"No weights at .*other\.safetensors"):
        load_generator(path.with_name("other.safetensors"), fingerprint=HERE, poses=PLAIN)
    path.with_suffix(".json").unlink()
    with pytest.raises(FileNotFoundError, match=r"lacks its manifest g\.json"):
        load_generator(path, fingerprint=HERE, poses=PLAIN)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "is damaged"),
        (b"\xff\xfe", "is damaged"),
        (b"[" * 100_000, "is damaged"),
        (b"{}", "lacks 'arguments'"),
        (b"[1]", "lacks 'arguments'"),
        (b'{"arguments": 3}', "lacks 'arguments'"),
    ],
)
def test_a_damaged_manifest_is_named(path: Path, content: bytes, message: str) -> None:
    path.with_suffix(".json").write_bytes(content)
    with pytest.raises(ValueError, match=rf"g\.json {message}"):
        load_generator(path, fingerprint=HERE, poses=PLAIN)


def test_damaged_weights_are_named(path: Path) -> None:
    manifest = json.loads(path.with_suffix(".json").read_text())
    edit_manifest(path, arguments=manifest["arguments"] | {"width": 9})
    with pytest.raises(ValueError, match=r"g\.safetensors does not fit"):
        load_generator(path, fingerprint=HERE, poses=PLAIN)
    edit_manifest(path, **manifest)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"g\.safetensors is damaged"):
        load_generator(path, fingerprint=HERE, poses=PLAIN)


def test_weights_that_are_not_shipped_are_said_to_be_missing() -> None:
    with pytest.raises(FileNotFoundError, match=r"'navigate-9m'.*train_generator"):
        shipped_weights("navigate-9m")


@pytest.mark.parametrize("environment", ["navigate-2m", "navigate-4m", "pebble", "pick-and-place-2m"])
def test_shipped_weights_are_loaded(environment: str) -> None:
    path = shipped_weights(environment)
    poses = FLAGGED if environment == "pick-and-place-2m" else PLAIN
    generator = load_generator(path, fingerprint={"environment": environment}, poses=poses)
    assert generator.image_shape == (64, 64, 3)
