"""The state of a training on disk: nested state dictionaries as one safetensors file. Nothing is ever unpickled."""

import json
import os
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

_TENSOR, _ITEMS = "tensor", "items"


def save_state(path: Path, state: dict[str, Any]) -> None:
    """Writes a state; a reader never meets a partial file.

    Args:
        path: where to.
        state: dictionaries with keys of str or int, lists, tuples, tensors, numbers, strings, bools and None, nested
            as they come.

    Raises:
        TypeError: if there is anything else in it.
    """
    tensors: dict[str, Tensor] = {}
    skeleton = _take_apart(state, tensors, "state")
    temporary = path.with_name(path.name + ".partial")
    save_file(tensors, temporary, metadata={"state": json.dumps(skeleton)})
    os.replace(temporary, path)


def load_state(path: Path) -> dict[str, Any]:
    """Returns what :func:`save_state` wrote; tuples come back as lists.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged or no state; names it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No state of a training at {path}: there is nothing to go on from.")
    try:
        with safe_open(path, framework="pt") as file:
            skeleton = json.loads((file.metadata() or {})["state"])
            state = _put_together(skeleton, {name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged, or no state of a training ({error}): copy it again.") from error
    if not isinstance(state, dict):
        raise ValueError(f"{path} is no state of a training: it holds no dictionary.")
    return state


def _take_apart(value: Any, tensors: dict[str, Tensor], name: str) -> Any:
    """Moves the tensors of a nested value into ``tensors``; returns what is left, ready for JSON."""
    if isinstance(value, Tensor):
        tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {_TENSOR: name}
    if isinstance(value, dict):
        # Pairs, for JSON would make strings of whole numbers as keys.
        return {_ITEMS: [[key, _take_apart(each, tensors, f"{name}.{key}")] for key, each in value.items()]}
    if isinstance(value, list | tuple):
        return [_take_apart(each, tensors, f"{name}.{number}") for number, each in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{name} is a {type(value).__name__}, which a state file does not hold")


def _put_together(value: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, list):
        return [_put_together(each, tensors) for each in value]
    if isinstance(value, dict):
        if _TENSOR in value:
            return tensors[value[_TENSOR]]
        return {key: _put_together(each, tensors) for key, each in value[_ITEMS]}
    return value
