"""Collection beside learning, in a process of its own, that repeats itself."""

import atexit
import copy
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import AsyncCollector
from torchrl.envs import EnvBase
from torchrl.weight_update import SharedMemWeightSyncScheme

from halgan_rl.training.lifeline import Lifeline


class BackgroundCollector(AsyncCollector):
    """TorchRL's collector in a process of its own, which acts by one policy for a whole batch.

    While a batch is learned from, the next one is collected. TorchRL's worker shares the learner's weights, and so acts
    by whatever they are at that moment. This one has a copy, brought up to date between two batches: each batch is
    collected by the policy as it was when the batch before was taken. With :meth:`set_seed` a run repeats itself.

    The worker ends with this process, however that ends.

    Args:
        make_env: makes the environment, in the other process; it must pickle.
        policy: explores; the attributes that change while learning must be its parameters or buffers.
        settings: see :class:`~torchrl.collectors.AsyncCollector`.
    """

    def __init__(self, make_env: Any, policy: TensorDictModuleBase, **settings: Any) -> None:
        self._latest = policy
        self._lifeline = Lifeline()
        self._sharing = SharedMemWeightSyncScheme()
        # TorchRL (0.14.1) leaves this to the interpreter's last moments, when it waits for ever.
        atexit.register(self._sharing.shutdown)
        try:
            super().__init__(
                _make_env,
                copy.deepcopy(policy),
                # Not a partial of _make_env: TorchRL pickles that by cloudpickle, which cannot send a pipe.
                create_env_kwargs={"make_env": make_env, "lifeline": self._lifeline},
                update_at_each_batch=True,
                weight_sync_schemes={"policy": self._sharing},
                **settings,
            )
        except BaseException:  # Ctrl-C, too, while the worker starts
            self._lifeline.cut()
            raise

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Brings the copy up to date; TorchRL calls this while the worker waits."""
        del args, kwargs
        self.policy.load_state_dict(self._latest.state_dict())

    def shutdown(self, timeout: float | None = 5.0, *args: Any, **kwargs: Any) -> None:
        """Ends the other process, after so many seconds whatever it does."""
        try:
            self._sharing.shutdown()
            atexit.unregister(self._sharing.shutdown)
            super().shutdown(timeout, *args, **kwargs)
        finally:  # also if a second Ctrl-C interrupts this
            self._lifeline.cut()


def _make_env(make_env: Any, lifeline: Lifeline) -> EnvBase:
    """Makes the environment in the worker, which is thereby on the lifeline."""
    lifeline.hold()
    return make_env()
