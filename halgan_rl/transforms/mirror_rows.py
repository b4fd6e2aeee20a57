"""Twice the data for a robot whose left and right are alike."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from halgan_rl.transforms.base import ReplayTransform, next_key


class MirrorRows(ReplayTransform):
    """Shows a share of the sampled rows as the same thing seen in a mirror.

    **Core rule.** A row is mirrored with the given probability: both images are flipped left to right, and those entries
    of the action change sign that point sideways. A goal to the left then calls for a turn to the left exactly as one to
    the right calls for a turn to the right; otherwise a critic that has seen few rewards prefers one direction
    everywhere, and the actor circles. Not in the paper.

    Put it last: poses are left as they are, and no longer belong to the images.

    Args:
        probability: Share of rows to mirror, in [0, 1].

    Keyword Args:
        generator: The source of all randomness here. Its state is part of ``state_dict()``.
        action_signs: Factor of each entry of the action ``[A]`` in the mirror: 1 keeps, -1 reverses it.
        pixels_key: Images uint8 ``[H, W, 3]``, at the root and under ``"next"``.
        action_key: Action ``[A]``.

    Raises:
        ValueError: If the probability is outside [0, 1], or a sign is neither 1 nor -1; on sampling, if actions have
            another size than there are signs.
        KeyError: On sampling, if a row lacks a key; names the key and the argument that set it.

    Examples:
        >>> from tensordict import TensorDict
        >>> frame = TensorDict({"pixels": torch.arange(6, dtype=torch.uint8).reshape(1, 1, 2, 3)}, batch_size=[1])
        >>> rows = frame.clone().update({"next": frame, "action": torch.tensor([[0.5, 0.2]])})
        >>> rows = MirrorRows(1.0, generator=torch.Generator().manual_seed(0))(rows)
        >>> rows["pixels"].flatten().tolist(), [round(entry, 1) for entry in rows["action"].flatten().tolist()]
        ([3, 4, 5, 0, 1, 2], [0.5, -0.2])
    """

    def __init__(
        self,
        probability: float = 0.5,
        *,
        generator: torch.Generator,
        action_signs: Sequence[float] = (1.0, -1.0),
        pixels_key: NestedKey = "pixels",
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        if not 0.0 <= probability <= 1.0:
            raise ValueError(f"probability must lie in [0, 1], got {probability}.")
        if any(sign not in (1.0, -1.0) for sign in action_signs):
            raise ValueError(f"action_signs must be 1 or -1, got {tuple(action_signs)}.")
        self.probability = probability
        self.generator = generator
        self.action_signs = torch.tensor(action_signs)
        self.pixels_key = pixels_key
        self.action_key = action_key

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Mirrors some of the sampled rows ``[...]``."""
        action = self._read(tensordict, self.action_key, "action_key")
        if action.shape[-1] != len(self.action_signs):
            raise ValueError(
                f"Actions have {action.shape[-1]} entries, action_signs has {len(self.action_signs)}: give one sign each."
            )
        shape = (*tensordict.batch_size, 1)
        uniform = torch.rand(shape, generator=self.generator, device=self.generator.device)
        mirrored = uniform.to(action.device) < self.probability
        signs = self.action_signs.to(action)
        tensordict.set(self.action_key, torch.where(mirrored, action * signs, action))
        for key in (self.pixels_key, next_key(self.pixels_key)):
            pixels = self._read(tensordict, key, "pixels_key")
            tensordict.set(key, torch.where(mirrored[..., None, None], pixels.flip(-2), pixels))
        return tensordict

    def get_extra_state(self) -> dict[str, Tensor]:
        """Returns the generator's state."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restores what :meth:`get_extra_state` returned."""
        self.generator.set_state(state["generator"].cpu())
