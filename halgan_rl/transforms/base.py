"""What all hindsight transforms share: they live in replay buffers only and never modify what is stored there."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from halgan_rl.keys import Keys, dotted


class ReplayTransform(Transform):
    """A transform of sampled rows: write :meth:`_edit_rows` and every property below holds.

    It refuses environments, records no gradients and never modifies the storage; an entry that is missing is reported
    with the field of ``keys`` that named its key. Rows that it could not edit are refused when they are written, before
    they reach the storage: see :meth:`_check_written`.

    Args:
        keys: where the rows keep what.
    """

    def __init__(self, keys: Keys) -> None:
        super().__init__()
        self.keys = keys

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns sampled rows ``[...]``, edited. The rows given are left alone."""
        # A slice of a full buffer is the storage's own TensorDict: setting an entry on it would replace what is stored.
        return self._edit_rows(tensordict.copy())

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets new entries on ``tensordict``, a shallow copy of the rows; writes into no tensor."""
        raise NotImplementedError(f"{type(self).__name__} must define _edit_rows.")

    @torch.no_grad()
    def _inv_call(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        """Checks new rows ``[...]``, and returns them as they are."""
        if tensordict is not None:
            self._check_written(tensordict)
        return tensordict

    def _check_written(self, rows: TensorDictBase) -> None:
        """Raises an error that says what to mend if new rows ``[...]`` could not be edited once they are sampled.

        Called at each write, so it looks at shapes and dtypes only.
        """

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attaches to a ``Compose``.

        Raises:
            TypeError: If that would attach the transform to an environment.
        """
        super().set_container(container)
        if self.parent is not None:
            raise TypeError(
                f"{type(self).__name__} edits replayed rows and cannot transform an environment. "
                "Append it to a replay buffer instead: replay_buffer.append_transform(transform)."
            )

    def _read(self, tensordict: TensorDictBase, name: str, key: NestedKey | None = None, remedy: str = "") -> Tensor:
        """Returns the entry at the key of the field ``name`` of ``keys``, or at ``key``, which derives from it."""
        key = getattr(self.keys, name) if key is None else key
        value = tensordict.get(key, None)
        if value is None:
            present = ", ".join(sorted(map(dotted, tensordict.keys(True, True))))
            raise KeyError(
                f"{type(self).__name__} misses the key {dotted(key)}, set by "
                f"keys=Keys({name}={getattr(self.keys, name)!r}). The rows hold {present}.{remedy}"
            )
        return value

    def _read_next(self, tensordict: TensorDictBase, name: str) -> Tensor:
        """Returns the entry of the field ``name`` of ``keys`` one step later."""
        return self._read(tensordict, name, self.keys.next(name))
