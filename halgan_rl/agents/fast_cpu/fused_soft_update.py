"""Target networks that follow, all their parameters in one call."""

import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.objectives import SoftUpdate


class FusedSoftUpdate(SoftUpdate):
    """TorchRL's SoftUpdate, without gathering the parameters anew at each step; arguments as there."""

    @torch.no_grad()
    def step(self) -> None:
        """Moves each target parameter by a fraction tau towards its source."""
        loss = self.loss_module
        pairs = loss.__dict__.get("_cached_pairs")  # erased by TorchRL, as all that begins so, when parameters move
        if pairs is None:
            pairs = loss.__dict__["_cached_pairs"] = self._gather()
        get_ema_multi_avg_fn(self.eps)(*pairs, None)

    def _gather(self) -> tuple[list[Tensor], list[Tensor]]:
        """Returns the target parameters and what they follow."""
        children = dict(self.loss_module.named_children())
        keys = [(name, *path) for name, *path in self._sources.keys(True, True)]
        targets = [children[f"target_{name}"][tuple(path)] for name, *path in keys]
        return targets, [children[name][tuple(path)] for name, *path in keys]
