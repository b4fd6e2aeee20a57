"""Target networks that follow, all their parameters in one call."""

from typing import Any

from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.objectives import LossModule, SoftUpdate


class FusedSoftUpdate(SoftUpdate):
    """TorchRL's SoftUpdate, which gathers the parameters anew at each step, with parameters gathered once.

    Args:
        loss_module: already where it will stay.
        **kwargs: see :class:`~torchrl.objectives.SoftUpdate`.
    """

    def __init__(self, loss_module: LossModule, **kwargs: Any) -> None:
        super().__init__(loss_module, **kwargs)
        keys = list(self._sources.keys(True, True))
        self._from = [self._sources[key].detach() for key in keys]
        self._to = [self._targets[f"target_{key[0]}", *key[1:]] for key in keys]
        self._average = get_ema_multi_avg_fn(self.eps)

    def step(self) -> None:
        """Move each target parameter by a fraction tau towards its source."""
        self._average(self._to, self._from, None)
