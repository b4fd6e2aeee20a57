"""Weights on disk: numbers as safetensors, and beside them a JSON manifest that says what they are.

Nothing is ever unpickled, so files from strangers are safe to open.
"""

import inspect
import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from halgan_rl.hallucination.generators.base import HallucinationGenerator, check_image_shape
from halgan_rl.hallucination.generators.config import GENERATORS
from halgan_rl.poses import PlanarPoses

_SHIPPED = Path(__file__).parent / "shipped"
_TRAIN = "train others: `python recipes/train_generator.py --environment {}`"

Module = TypeVar("Module", bound=nn.Module)


def save_weights(path: Path, module: nn.Module, manifest: Mapping[str, Any]) -> None:
    """Writes ``path`` and its manifest, the same name with ``.json``; a reader never meets a partial file.

    Args:
        path: where to; ends in ``.safetensors``.
        module: whose parameters and buffers to save.
        manifest: JSON content; ``arguments`` rebuild the module, and whatever later has to be compared.

    Raises:
        ValueError: if the path ends otherwise.
    """
    if path.suffix != ".safetensors":
        raise ValueError(f"{path} must end in .safetensors.")
    tensors = {name: tensor.detach().contiguous().cpu() for name, tensor in module.state_dict().items()}
    text = json.dumps(dict(manifest), indent=2, default=str) + "\n"
    _replace(path, lambda temporary: save_file(tensors, temporary))
    _replace(path.with_suffix(".json"), lambda temporary: temporary.write_text(text))


def load_module(path: Path, build: Callable[..., Module]) -> tuple[Module, dict[str, Any]]:
    """Rebuilds a network from its manifest and weights.

    Args:
        path: the ``.safetensors`` file; its manifest lies beside it.
        build: makes the network from the manifest's ``arguments``.

    Returns:
        The network, and the manifest.

    Raises:
        FileNotFoundError: if weights or manifest are missing.
        ValueError: if a file is damaged, the arguments make no network, or the weights do not fit it.
    """
    manifest = read_manifest(path)
    return _rebuild(path, build, manifest["arguments"]), manifest


def load_generator(
    path: Path,
    *,
    fingerprint: Mapping[str, str],
    poses: PlanarPoses,
    image_shape: Sequence[int] = (64, 64, 3),
    frame_stack: int = 1,
    allow_other_mujoco: bool = False,
) -> HallucinationGenerator:
    """Rebuilds a hallucination generator, if it was trained on images like those at hand.

    The manifest is checked before anything is built.

    Args:
        path: the ``.safetensors`` file.

    Keyword Args:
        fingerprint: what the images of the environment at hand depend on; each entry is compared with the manifest's,
            except ``gl``, whose effect the golden frame shows. Without entries nothing is compared.
        poses: of that environment.
        image_shape: height, width and channels of its images.
        frame_stack: how many frames are stacked along the channels.
        allow_other_mujoco: accept weights that were trained with another release of MuJoCo.

    Returns:
        The generator, in eval mode, on the CPU.

    Raises:
        FileNotFoundError: if weights or manifest are missing.
        ValueError: if a file is damaged or no generator's, or the weights are for other images, poses or fingerprints;
            names the file and the field.

    Warns:
        UserWarning: if only the golden frame differs: another OpenGL driver draws slightly other images.
    """
    manifest = read_manifest(path)
    if manifest.get("kind") not in list(GENERATORS):  # a list: the kind may be anything
        raise ValueError(
            f"{_named(path, 'kind')} is {manifest.get('kind')!r}, no generator's: it must be one of "
            f"{', '.join(GENERATORS)}. Choose the weights of a generator."
        )
    build, arguments = GENERATORS[manifest["kind"]], manifest["arguments"]
    _check_names(path, build, arguments)
    _check_environment(path, manifest, fingerprint, allow_other_mujoco=allow_other_mujoco)
    here = {
        "image_shape": list(check_image_shape(image_shape, frame_stack)),
        "frame_stack": frame_stack,
        "pose_size": poses.size,
    }
    for field, value in here.items():
        if arguments[field] != value:
            raise ValueError(
                f"{_named(path, field)} is {arguments[field]!r}, but here it is {value!r}: choose weights of an "
                f"environment with such images and poses, or {_TRAIN.format(fingerprint.get('environment', '...'))}."
            )
    return _rebuild(path, build, arguments).eval()


def shipped_weights(environment: str) -> Path:
    """Returns the path of the generator that comes with the package.

    Raises:
        FileNotFoundError: if there is none for this environment.
    """
    path = _SHIPPED / f"{environment}.safetensors"
    if not path.exists():
        known = ", ".join(sorted(file.stem for file in _SHIPPED.glob("*.safetensors"))) or "none"
        raise FileNotFoundError(
            f"No generator is shipped for {environment!r} (shipped: {known}): train one with "
            f"`python recipes/train_generator.py --environment {environment}`, and name its file as the weights."
        )
    return path


def read_manifest(path: Path) -> dict[str, Any]:
    """Returns the manifest of weights.

    Raises:
        FileNotFoundError: if weights or manifest are missing.
        ValueError: if the manifest is no JSON object or lacks ``arguments``.
    """
    manifest_path = path.with_suffix(".json")
    if not path.is_file():
        raise FileNotFoundError(f"No weights at {path}: check the path, it should name a .safetensors file.")
    if not manifest_path.is_file():
        raise FileNotFoundError(f"{path} lacks its manifest {manifest_path.name}: copy both files together.")
    try:
        manifest = json.loads(manifest_path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, or too deep
        raise ValueError(f"{manifest_path} is damaged ({error}): copy it again.") from error
    if not isinstance(manifest, dict) or not isinstance(manifest.get("arguments"), dict):
        raise ValueError(
            f"{manifest_path} lacks 'arguments', an object that rebuilds the network: it is no manifest of weights."
        )
    return manifest


def _check_names(path: Path, build: Callable[..., nn.Module], arguments: Mapping[str, Any]) -> None:
    """Refuses arguments of other names than the network's: a missing one would silently become a default."""
    known = list(inspect.signature(build).parameters)
    for problem, names in (
        ("lacks", [name for name in known if name not in arguments]),
        ("has the unknown", [name for name in arguments if name not in known]),
    ):
        if names:
            raise ValueError(
                f"{path.with_suffix('.json')} {problem} {', '.join(map(repr, names))} in its 'arguments', which must "
                f"be {', '.join(known)}: it was written by another version. Train the generator again."
            )


def _check_environment(
    path: Path, manifest: Mapping[str, Any], fingerprint: Mapping[str, str], *, allow_other_mujoco: bool
) -> None:
    """Refuses weights of another environment; warns if only its golden frame differs."""
    train = _TRAIN.format(fingerprint.get("environment", "..."))
    for field, here in fingerprint.items():
        if field == "gl" or (field == "mujoco" and allow_other_mujoco):
            continue
        if field not in manifest:
            raise ValueError(
                f"{path.with_suffix('.json')} lacks {field!r}, here {here!r}: nothing says that {path.name} was "
                f"trained on such images. Choose other weights, or {train}."
            )
        there = manifest[field]
        if field == "golden_frame" and isinstance(there, str):
            if there != here:
                warnings.warn(
                    f"{path} was trained on slightly other images than this machine renders (another OpenGL driver?): "
                    f"look at hallucinations.png, and if it disappoints, {train}.",
                    stacklevel=3,
                )
        elif there != here:
            accept = ", install that release, or allow_other_mujoco=True" if field == "mujoco" else ""
            raise ValueError(
                f"{_named(path, field)} is {there!r}, but here it is {here!r}: choose other weights{accept}, "
                f"or {train}."
            )


def _rebuild(path: Path, build: Callable[..., Module], arguments: Mapping[str, Any]) -> Module:
    try:
        network = build(**arguments)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path.with_suffix('.json')} has 'arguments' that make no network: {error}") from error
    try:
        network.load_state_dict(load_file(path))
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged ({error}): copy it again.") from error
    except RuntimeError as error:
        raise ValueError(f"{path} does not fit the network of its manifest: copy both files together.") from error
    return network


def _named(path: Path, field: str) -> str:
    return f"{path.with_suffix('.json')}: {field!r}"


def _replace(path: Path, write: Callable[[Path], Any]) -> None:
    temporary = path.with_name(path.name + ".partial")
    write(temporary)
    os.replace(temporary, path)
