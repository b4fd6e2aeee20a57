"""Checkpoints of a frame storage."""

import json
import os
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage
from torchrl.data.replay_buffers.checkpointers import StorageCheckpointerBase


class FrameStorageCheckpointer(StorageCheckpointerBase):
    """Keeps a ``FrameStorage`` in a safetensors file: numbers only, nothing is ever unpickled."""

    FILE = "frame_storage.safetensors"

    def dumps(self, storage: LazyTensorStorage, path: str | Path) -> None:
        """Writes the rows into the folder ``path``; a reader never meets a partial file."""
        self._refuse_hooks()
        state = TensorDict.from_dict(storage.state_dict(), batch_size=[])
        tensors = {json.dumps(key): value for key, value in state.items(True, True)}
        target = Path(path, self.FILE)
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f"{self.FILE}.partial")
        try:
            save_file(tensors, partial)
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)

    def loads(self, storage: LazyTensorStorage, path: str | Path) -> None:
        """Restores what :meth:`dumps` wrote.

        Raises:
            FileNotFoundError: if the folder holds no such file.
            ValueError: if the file is damaged, or does not fit the storage.
        """
        self._refuse_hooks()
        source = Path(path, self.FILE)
        if not source.is_file():
            raise FileNotFoundError(f"no checkpoint of a FrameStorage at {source}: check the path")
        try:
            tensors = load_file(source)
        except SafetensorError as error:
            raise ValueError(f"{source} is damaged ({error}): copy it again") from error
        state = TensorDict(batch_size=[])
        for name, value in tensors.items():
            key = json.loads(name)
            state.set(key if isinstance(key, str) else tuple(key), value)
        storage.load_state_dict(state.to_dict())

    def _refuse_hooks(self) -> None:
        if self._save_hooks or self._load_hooks:
            raise ValueError("FrameStorage knows no hooks on saving and loading: do not register any")
