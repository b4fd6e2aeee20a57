"""Weights on disk: numbers as safetensors, and beside them a JSON manifest that says what they are.

Nothing is ever unpickled, so files from strangers are safe to open.
"""

import json
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import HallucinationGenerator, PaperGenerator

GENERATORS: dict[str, Callable[..., HallucinationGenerator]] = {
    "coordinates": CoordinateGenerator,
    "paper": PaperGenerator,
}
"""The generators that a manifest may name as its ``kind``."""

_SHIPPED = Path(__file__).parent / "shipped"

Module = TypeVar("Module", bound=nn.Module)


def save_weights(path: Path, module: nn.Module, manifest: Mapping[str, Any]) -> None:
    """Write ``path`` and its manifest, the same name with ``.json``; a reader never meets a partial file.

    Args:
        path: where to; ends in ``.safetensors``.
        module: whose parameters and buffers to save.
        manifest: JSON content; ``arguments`` rebuild the module, and whatever later has to be compared.

    Raises:
        ValueError: if the path ends otherwise.
    """
    if path.suffix != ".safetensors":
        raise ValueError(f"{path} must end in .safetensors")
    tensors = {name: tensor.detach().contiguous().cpu() for name, tensor in module.state_dict().items()}
    text = json.dumps(dict(manifest), indent=2, default=str) + "\n"
    _replace(path, lambda temporary: save_file(tensors, temporary))
    _replace(path.with_suffix(".json"), lambda temporary: temporary.write_text(text))


def load_module(path: Path, build: Callable[..., Module]) -> tuple[Module, dict[str, Any]]:
    """Rebuild a network from its manifest and weights.

    Args:
        path: the ``.safetensors`` file; its manifest lies beside it.
        build: makes the network from the manifest's ``arguments``.

    Returns:
        The network, and the manifest.

    Raises:
        FileNotFoundError: if weights or manifest are missing.
        ValueError: if a file is damaged, or the weights do not fit the network.
    """
    manifest = read_manifest(path)
    network = build(**manifest["arguments"])
    _load_state(path, network)
    return network, manifest


def load_generator(
    path: Path,
    *,
    expected: Mapping[str, str],
    pose_size: int = 3,
    allow_other_mujoco: bool = False,
) -> HallucinationGenerator:
    """Rebuild a hallucination generator, if it was trained on images like those at hand.

    Args:
        path: the ``.safetensors`` file.
        expected: the fingerprint of the environment at hand: ``environment``, ``mujoco``, ``golden_frame``.
        pose_size: P, entries of a pose in that environment.
        allow_other_mujoco: accept weights that were trained with another release of MuJoCo.

    Returns:
        The generator, in eval mode, on the CPU.

    Raises:
        FileNotFoundError: if weights or manifest are missing.
        ValueError: if the weights are damaged, no generator's, or of another environment, pose size or MuJoCo.

    Warns:
        UserWarning: if only the golden frame differs: another OpenGL driver draws slightly other images.
    """
    manifest = read_manifest(path)
    kind, arguments = manifest.get("kind"), manifest["arguments"]
    if kind not in GENERATORS:
        raise ValueError(f"{path} holds a {kind!r}, no generator: choose one of {', '.join(GENERATORS)}")
    if manifest.get("environment") != expected["environment"]:
        raise ValueError(
            f"{path} was trained for {manifest.get('environment')!r}, not for {expected['environment']!r}: choose "
            f"other weights, or train some: `python recipes/train_halgan.py --environment {expected['environment']}`"
        )
    if arguments["pose_size"] != pose_size:
        raise ValueError(
            f"{path} was trained on poses of {arguments['pose_size']} entries, not {pose_size}: train others"
        )
    if manifest.get("mujoco") != expected["mujoco"] and not allow_other_mujoco:
        raise ValueError(
            f"{path} was trained with MuJoCo {manifest.get('mujoco')}, this is {expected['mujoco']}, whose images may "
            "differ: install that release, train other weights, or pass allow_other_mujoco=True"
        )
    if manifest.get("golden_frame") != expected["golden_frame"]:
        warnings.warn(
            f"{path} was trained on slightly other images than this machine renders (another OpenGL driver?): look at "
            "hallucinations.png, and if it disappoints, train other weights",
            stacklevel=2,
        )
    generator = GENERATORS[kind](**arguments)
    _load_state(path, generator)
    return generator.eval()


def shipped_weights(environment: str) -> Path:
    """Return the path of the generator that comes with the package.

    Raises:
        FileNotFoundError: if there is none for this environment.
    """
    path = _SHIPPED / f"{environment}.safetensors"
    if not path.exists():
        known = ", ".join(sorted(file.stem for file in _SHIPPED.glob("*.safetensors"))) or "none"
        raise FileNotFoundError(
            f"no generator is shipped for {environment!r} (shipped: {known}): train one with "
            f"`python recipes/train_halgan.py --environment {environment}` and pass it as --weights"
        )
    return path


def read_manifest(path: Path) -> dict[str, Any]:
    """Return the manifest of weights.

    Raises:
        FileNotFoundError: if weights or manifest are missing.
        ValueError: if the manifest is no JSON or lacks ``arguments``.
    """
    manifest_path = path.with_suffix(".json")
    if not path.is_file():
        raise FileNotFoundError(f"no weights at {path}: check the path, it should name a .safetensors file")
    if not manifest_path.is_file():
        raise FileNotFoundError(f"{path} lacks its manifest {manifest_path.name}: copy both files together")
    try:
        manifest = json.loads(manifest_path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{manifest_path} is damaged ({error}): copy it again") from error
    if "arguments" not in manifest:
        raise ValueError(f"{manifest_path} lacks 'arguments', which rebuild the network: it is no manifest of weights")
    return manifest


def _load_state(path: Path, network: nn.Module) -> None:
    try:
        network.load_state_dict(load_file(path))
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged ({error}): copy it again") from error
    except RuntimeError as error:
        raise ValueError(f"{path} does not fit the network of its manifest: copy both files together") from error


def _replace(path: Path, write: Callable[[Path], Any]) -> None:
    temporary = path.with_name(path.name + ".partial")
    write(temporary)
    os.replace(temporary, path)
