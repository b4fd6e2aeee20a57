"""Names of TensorDict keys: one object that travels through everything that reads or writes rows."""

from dataclasses import dataclass

from tensordict import NestedKey, unravel_key


@dataclass(frozen=True)
class Keys:
    """Where rows of a replay buffer keep what. The defaults are TorchRL's.

    Examples:
        >>> keys = Keys(pixels=("camera", "rgb"))
        >>> dotted(keys.next("pixels")), dotted(keys.goal_mask)
        ('next.camera.rgb', 'goal.mask')
    """

    pixels: NestedKey = "pixels"
    """Image ``[H, W, C]`` uint8, at the root and under ``"next"``."""
    pose: NestedKey = "pose"
    """Pose ``[P]`` float32, at the root and under ``"next"``."""
    action: NestedKey = "action"
    """Action ``[A]``, at the root."""
    reward: NestedKey = "reward"
    """Reward ``[1]``, under ``"next"``."""
    done: NestedKey = "done"
    """End-of-episode flag ``[1]``, under ``"next"``."""
    terminated: NestedKey = "terminated"
    """Termination flag ``[1]``, under ``"next"``."""
    truncated: NestedKey = "truncated"
    """Time-limit flag ``[1]``, under ``"next"``."""
    success: NestedKey | None = None
    """Success flag ``[1]``, under ``"next"``; None: a termination, or a reward above a threshold, is a success."""
    hindsight: NestedKey = "hindsight"
    """Where each row's future is stored: ``"pose"`` ``[D, P]``, ``"horizon"`` ``[1]`` int64, ``"reward"`` ``[n]``."""
    goal: NestedKey = "goal"
    """Where a sampled row's goal is written: ``"mask"`` ``[1]`` bool and ``"pose"`` ``[P]``."""

    def next(self, name: str) -> NestedKey:
        """Returns the key of a field's entry one step later: ``keys.next("pose")`` is ``("next", "pose")``."""
        return next_key(getattr(self, name))

    @property
    def hindsight_pose(self) -> NestedKey:
        """Future poses ``[D, P]``."""
        return unravel_key((self.hindsight, "pose"))

    @property
    def hindsight_horizon(self) -> NestedKey:
        """How many of the future poses may serve as a goal, int64 ``[1]``."""
        return unravel_key((self.hindsight, "horizon"))

    @property
    def hindsight_reward(self) -> NestedKey:
        """Rewards of the next n steps ``[n]``, of rows that span several steps."""
        return unravel_key((self.hindsight, "reward"))

    @property
    def goal_mask(self) -> NestedKey:
        """Whether a sampled row is relabelled, bool ``[1]``."""
        return unravel_key((self.goal, "mask"))

    @property
    def goal_pose(self) -> NestedKey:
        """The goal pose ``[P]`` of a sampled row."""
        return unravel_key((self.goal, "pose"))


def next_key(key: NestedKey) -> NestedKey:
    """Returns the key of the same entry one step later: ``("next", *key)``."""
    return unravel_key(("next", key))


def dotted(key: NestedKey) -> str:
    """Writes a key for people: ``next.pose``."""
    return key if isinstance(key, str) else ".".join(key)
