"""Collection beside learning, in a process of its own, that repeats itself."""

import copy
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import AsyncCollector
from torchrl.weight_update import SharedMemWeightSyncScheme


class BackgroundCollector(AsyncCollector):
    """TorchRL's collector in a process of its own, which acts by one policy for a whole batch.

    While a batch is learned from, the next one is collected. TorchRL's worker shares the learner's weights, and so acts
    by whatever they are at that moment. This one has a copy, brought up to date between two batches: each batch is
    collected by the policy as it was when the batch before was taken. With :meth:`set_seed` a run repeats itself.

    Args:
        make_env: makes the environment, in the other process; it must pickle.
        policy: explores; the attributes that change while learning must be its parameters or buffers.
        settings: see :class:`~torchrl.collectors.AsyncCollector`.
    """

    def __init__(self, make_env: Any, policy: TensorDictModuleBase, **settings: Any) -> None:
        self._latest = policy
        self._sharing = SharedMemWeightSyncScheme()
        super().__init__(
            make_env,
            copy.deepcopy(policy),
            update_at_each_batch=True,
            weight_sync_schemes={"policy": self._sharing},
            **settings,
        )

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Bring the copy up to date; TorchRL calls this while the worker waits."""
        del args, kwargs
        self.policy.load_state_dict(self._latest.state_dict())

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """End the other process."""
        super().shutdown(*args, **kwargs)
        self._sharing.shutdown()  # which TorchRL (0.14.1) leaves to the interpreter's end, where it waits for ever
