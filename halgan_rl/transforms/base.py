"""What all hindsight transforms share: they live in replay buffers only and never modify what is stored there."""

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform


class ReplayTransform(Transform):
    """A transform of sampled rows: write :meth:`_edit_rows` and every property below holds.

    It refuses environments, records no gradients and never modifies the storage; an entry that is missing is reported
    with the constructor argument that named its key.
    """

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns sampled rows ``[...]``, edited. The rows given are left alone."""
        # A slice of a full buffer is the storage's own TensorDict: setting an entry on it would replace what is stored.
        return self._edit_rows(tensordict.copy())

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets new entries on ``tensordict``, a shallow copy of the rows; writes into no tensor."""
        raise NotImplementedError(f"{type(self).__name__} must define _edit_rows.")

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

    def _read(self, tensordict: TensorDictBase, key: NestedKey, argument: str) -> Tensor:
        """Returns the entry at ``key``; ``argument`` is the constructor argument that chose it."""
        value = tensordict.get(key, None)
        if value is None:
            present = ", ".join(sorted(map(dotted, tensordict.keys(True, True))))
            raise KeyError(
                f"{type(self).__name__} misses the key {dotted(key)}, set by the constructor argument "
                f"{argument}={getattr(self, argument)!r}. The rows hold {present}."
            )
        return value


def dotted(key: NestedKey) -> str:
    """Writes a key for people: ``next.pose``."""
    return key if isinstance(key, str) else ".".join(key)


def next_key(key: NestedKey) -> NestedKey:
    """Returns the key of the same entry one step later: ``("next", *key)``."""
    return unravel_key(("next", key))
