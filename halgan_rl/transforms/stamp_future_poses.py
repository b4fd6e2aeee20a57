"""The write path of hindsight: every row learns where its episode went next."""

import warnings
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import MultiStepTransform, Transform

from halgan_rl.keys import Keys, dotted
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.transforms.base import ReplayTransform
from halgan_rl.transforms.consecutive_rows import (
    check_continuity,
    check_layout,
    check_reach,
    check_unpadded,
    dense,
    layout_of,
)
from halgan_rl.transforms.held_rows import HeldRows
from halgan_rl.transforms.n_step_rows import STEPS_KEY, future_rewards, n_step_rows
from halgan_rl.transforms.unfinished_episode import Steps, UnfinishedEpisode, concatenate, future_poses

ENOUGH_ROWS = 1_000
"""Rows of which some should have a usable goal."""


class StampFuturePoses(ReplayTransform):
    """Stamps on each row, as it is written, the poses that its episode visits next.

    **Core rule.** Row t gets ``(hindsight, "pose")``, the poses at t+1 ... t+D, and ``(hindsight, "horizon")``, how
    many of them may serve as a goal in hindsight: those before any success and the end of the episode. A success is a
    termination, or a reward above ``success_threshold``, or the flag that ``keys.success`` names. The last pose of an
    episode cut by its time limit is a usable goal; that of one that ended by success is not. Where the flags of the
    pose change, a stage of the task is completed, as at a pick-up: that pose is a usable goal, the last one. Horizon 0
    means that the row is never relabelled. Beyond the episode's end its last pose is repeated.

    A row is held back until D steps or its episode's end are known, so at most D - 1 rows an environment wait here, and
    an extension of the buffer may write fewer rows than it was given, or none. Use ``extend``, with rows in order of
    time: ``[T]`` for one environment, ``[E, T]`` for several (time last, as TorchRL's collectors give them). What
    reaches the storage is flat, ``[N]``, one environment after the other, so the storage must be one-dimensional (its
    default). Any sampler, storage and writer will do: a row carries all that hindsight asks of it, also after the ring
    has wrapped. (A sampler of slices finds unbroken trajectories only if one environment writes.)

    Rows held back are part of ``state_dict()``, hence of a buffer's checkpoint. :meth:`flush` releases them early.
    Rows that already carry both hindsight keys, such as those from :meth:`flush`, pass through as they are.

    **n-step returns.** With ``n_steps=n`` a row spans n steps, fewer at its episode's end: its reward is their
    discounted sum, all under ``"next"`` is what follows the last of them, and ``"steps_to_next_obs"`` counts them, as
    TorchRL's losses expect. The hindsight keys still count single steps, and ``(hindsight, "reward")`` holds the n
    rewards, so that a goal may be reached at any of the steps. This is the one way to n-step returns with hindsight:
    rows that a ``MultiStepTransform`` changed, before this transform or after it, are refused.

    **Environments.** What follows a terminal row must be the last observation of its own episode, or goals cross
    episodes. So it is, with TorchRL's collectors, for ``GymEnv(id)``, for ``SerialEnv`` and ``ParallelEnv``, for a
    ``TransformedEnv`` around them, and for a vectorised Gymnasium environment with ``AutoresetMode.DISABLED``. It is
    not for ``GymEnv(id, num_envs=n)``, nor for a vectorised environment with ``AutoresetMode.SAME_STEP``: there it is
    the next episode's first observation, or zeros (torchrl 0.14.1). Give ``max_step``, and such rows are refused.

    Args:
        max_distance: D, the furthest goal in steps (the paper's longest failed segment: 32 for Navigate).

    Keyword Args:
        success_threshold: A greater reward is a success. Give what any step may earn, such as an alive bonus.
        max_step: The longest distance [m] from a row's pose to its next pose; None if it is not known.
        n_steps: Steps that a row spans, at most ``max_distance``.
        discount: Discount of a step; needed for ``n_steps`` greater than 1, and then that of the loss.
        poses: What the entries of a pose mean.
        keys: Where rows keep what.

    Raises:
        ValueError: If an argument is out of range; on writing, if a pose is none, if rows are not consecutive steps,
            are padding, or have other dtypes or shapes than those held back. Such a batch is refused whole: the rows
            held back stay what they were.
        KeyError: On writing, if a row lacks a key; names the key and the argument that set it. Likewise if rows have
            other keys than those held back.

    Warns:
        UserWarning: Once, if none of the first 1,000 rows has a usable goal.

    Examples:
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(100), transform=StampFuturePoses(max_distance=2))
        >>> x = torch.arange(5.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        >>> flag = torch.tensor([[False], [False], [False], [True]])
        >>> following = {"pose": x[1:], "reward": torch.zeros(4, 1), "done": flag, "terminated": flag & False}
        >>> _ = buffer.extend(TensorDict({"pose": x[:-1], "next": following}, batch_size=[4]))
        >>> buffer[:]["hindsight", "pose"][..., 0].tolist()
        [[1.0, 2.0], [2.0, 3.0], [3.0, 4.0], [4.0, 4.0]]
        >>> buffer[:]["hindsight", "horizon"].flatten().tolist()
        [2, 2, 2, 1]
    """

    def __init__(
        self,
        max_distance: int = 32,
        *,
        success_threshold: float = 0.0,
        max_step: float | None = None,
        n_steps: int = 1,
        discount: float | None = None,
        poses: Poses = PlanarPoses(),
        keys: Keys = Keys(),
    ) -> None:
        super().__init__(keys)
        if max_distance < 1:
            raise ValueError(f"max_distance must be at least 1 step, got {max_distance}.")
        if not 1 <= n_steps <= max_distance:
            raise ValueError(f"n_steps must be between 1 and max_distance={max_distance}, got {n_steps}.")
        if n_steps > 1 and not (discount is not None and 0 <= discount <= 1):
            raise ValueError(f"n_steps={n_steps} needs the discount of the loss, between 0 and 1, got {discount}.")
        if max_step is not None and not max_step > 0:
            raise ValueError(f"max_step must be positive, in metres, got {max_step}.")
        self.max_distance = max_distance
        self.success_threshold = success_threshold
        self.max_step = max_step
        self.n_steps = n_steps
        self.discount = 1.0 if discount is None else discount
        self.poses = poses
        self._held = HeldRows()
        self._goalless: int | None = 0  # rows stamped while none had a usable goal; None once one had, or after warning

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves sampled rows as they are: all the work is done when rows are written."""
        return tensordict

    @torch.no_grad()
    def _inv_call(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        """Takes new rows ``[T]`` or ``[E, T]``; returns those whose future is now known, flat, or None."""
        if tensordict is None or 0 in tensordict.batch_size:
            self._held.passed(None)
            return None
        if self._is_stamped(tensordict):
            return self._pass(tensordict)
        self._refuse_other_n_step_returns(tensordict)
        rows = self._by_environment(tensordict)
        check_unpadded(rows)
        steps, layout = self._read_steps(rows), layout_of(rows)
        waiting = self._held.copy(len(rows))
        check_layout(layout, waiting)
        check_continuity(steps, waiting)
        ready: list[TensorDictBase] = []
        for e, each in enumerate(waiting):
            each.append(rows[e], Steps(*(entry[e] for entry in steps)), layout)
            ready += self._release(each, each.count_known(self.max_distance))
            each.own_last_chunk()
        released = concatenate(ready)
        self._held.write(waiting)
        return released

    def flush(self) -> TensorDictBase | None:
        """Releases the rows held back, stamped with the future that is known so far.

        For the end of a run, or before the environments are reset in mid-episode: write what this returns with
        ``replay_buffer.extend``, which leaves stamped rows as they are. If a ``FrameStorage`` refuses them, they are
        held back again.

        Returns:
            Rows ``[N]``, or None if none were held back.
        """
        waiting = self._held.copy(environments=0)
        released = concatenate([chunk for each in waiting for chunk in self._release(each, each.count)])
        self._held.write([], flushed=None if released is None else released.get(self.keys.hindsight_horizon))
        return released

    def undo_write(self) -> None:
        """Takes the last write back: the rows held back are again those before it.

        A storage that refuses the rows of a write calls this, as ``FrameStorage`` does, so that nothing is lost. A
        second call changes nothing.
        """
        self._held.undo()

    def drop_held_rows(self) -> None:
        """Forgets the rows held back, as ``replay_buffer.empty()`` does on a ``FrameStorage``.

        Other storages do not know of this transform: call it when you empty their buffer in mid-episode.
        """
        self._held.drop()

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the rows held back, as plain dictionaries of tensors, one an environment, and how they are read."""
        states: list[dict[str, Any] | None] = []
        for waiting in self._held.waiting:
            rows = concatenate(list(waiting.chunks))
            states.append(None if rows is None else {"count": len(rows), "rows": rows.to_dict()})
        return {"max_distance": self.max_distance, "n_steps": self.n_steps, "waiting": states}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`get_extra_state` returned.

        Raises:
            ValueError: if the state was written with another ``max_distance`` or ``n_steps``.
        """
        for name in ("max_distance", "n_steps"):
            if state[name] != getattr(self, name):
                raise ValueError(
                    f"This state was written with {name}={state[name]}, this transform has {name}="
                    f"{getattr(self, name)}, and their rows cannot be mixed: build it with {name}={state[name]}, or "
                    "start with an empty buffer."
                )
        waiting = [UnfinishedEpisode() for _ in state["waiting"]]
        for each, saved in zip(waiting, state["waiting"], strict=True):
            if saved is not None:
                rows = TensorDict.from_dict(saved["rows"], batch_size=[saved["count"]])
                each.append(rows, self._read_steps(rows), layout_of(rows))
        self._held.drop(waiting)

    def _is_stamped(self, tensordict: TensorDictBase) -> bool:
        keys = (self.keys.hindsight_pose, self.keys.hindsight_horizon)  # their get() knows lazy stacks, keys() does not
        return all(tensordict.get(key, None) is not None for key in keys)

    def _pass(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns stamped rows as they are; refuses those of another ``max_distance``."""
        distance = tensordict.get(self.keys.hindsight_pose).shape[-2]
        if distance != self.max_distance:
            raise ValueError(
                f"These rows hold {distance} future poses each ({dotted(self.keys.hindsight_pose)}), this transform "
                f"stamps max_distance={self.max_distance}: write rows of one max_distance."
            )
        self._held.passed(tensordict.get(self.keys.hindsight_horizon))
        return tensordict

    def _refuse_other_n_step_returns(self, tensordict: TensorDictBase) -> None:
        """Refuses rows that span several steps already, or will after this transform."""
        spanning = tensordict.get(STEPS_KEY, None) is not None
        if spanning or (not self._held.waiting and _any_multi_step(self)):
            raise ValueError(
                "A MultiStepTransform (or MultiStep) changes these rows, so that hindsight cannot know at which of "
                "their steps a goal is reached. Remove it: StampFuturePoses(max_distance, n_steps=n, discount=g) makes "
                "n-step returns itself, and pipelines.halgan(..., n_steps=n, discount=g) sets up the rest."
            )

    def _by_environment(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the rows as ``[E, T]``."""
        if tensordict.batch_dims == 0:
            raise ValueError(
                "StampFuturePoses holds rows back and cannot take them through add(): "
                "write them with replay_buffer.extend(row.unsqueeze(0))."
            )
        rows = dense(tensordict).reshape(-1, tensordict.batch_size[-1])
        if self._held.waiting and len(rows) != len(self._held.waiting):
            raise ValueError(
                f"These rows come from {len(rows)} environments (batch size {tuple(tensordict.batch_size)}), those "
                f"held back from {len(self._held.waiting)}. Write those first: replay_buffer.extend(transform.flush())."
            )
        return rows

    def _read_steps(self, rows: TensorDictBase) -> Steps:
        """Reads what hindsight needs to know of each row, ``[..., T]``."""
        done = self._read_next(rows, "done").reshape(rows.shape)
        terminated = self._read_next(rows, "terminated").reshape(rows.shape)
        reward = self._read_next(rows, "reward").reshape(rows.shape)
        pose, next_pose = self._read(rows, "pose"), self._read_next(rows, "pose")
        self.poses.check(pose, f"{type(self).__name__}: the entry {dotted(self.keys.pose)}")
        self.poses.check(next_pose, f"{type(self).__name__}: the entry {dotted(self.keys.next('pose'))}")
        if self.max_step is not None:
            check_reach(pose, next_pose, self.poses, self.max_step)
        success = reward > self.success_threshold if self.keys.success is None else self._read_success(rows)
        turned = self.poses.stage_changed(pose, next_pose)
        return Steps(pose, next_pose, reward, last=done | terminated, solved=terminated | success, turned=turned)

    def _read_success(self, rows: TensorDictBase) -> Tensor:
        """Reads the flag of success, bool ``[..., T]``."""
        success = self._read_next(rows, "success")
        if success.dtype != torch.bool or success.numel() != rows.numel():
            raise ValueError(
                f"StampFuturePoses: the entry {dotted(self.keys.next('success'))} is {success.dtype} "
                f"{tuple(success.shape)}, but a success is one bool a row, here {(*rows.shape, 1)}."
            )
        return success.reshape(rows.shape)

    def _release(self, waiting: UnfinishedEpisode, count: int) -> list[TensorDictBase]:
        """Takes the first ``count`` rows off those held back, with their hindsight stamped on them."""
        if count == 0:
            return []
        steps, chunks = waiting.steps, list(waiting.chunks)
        poses, horizons = future_poses(steps, count, self.max_distance)
        released = waiting.pop(count)
        if self.n_steps > 1:
            released = [n_step_rows(concatenate(chunks), steps, count, self.n_steps, self.discount, self.keys)]
            released[0].set(self.keys.hindsight_reward, future_rewards(steps, count, self.n_steps))
        start = 0
        for chunk in released:
            span = slice(start, start := start + len(chunk))
            chunk.set(self.keys.hindsight_pose, poses[span])
            chunk.set(self.keys.hindsight_horizon, horizons[span])
        self._warn_if_goalless(horizons)
        return released

    def _warn_if_goalless(self, horizons: Tensor) -> None:
        """Warns once if none of many rows has a usable goal, for then hindsight does nothing."""
        if self._goalless is None:
            return
        self._goalless = None if horizons.any() else self._goalless + len(horizons)
        if self._goalless is not None and self._goalless >= ENOUGH_ROWS:
            warnings.warn(
                f"None of {self._goalless} rows can be relabelled: each is a success itself (all horizons are 0), that "
                f"is, terminated or rewarded with more than success_threshold={self.success_threshold}. If every step "
                "earns something, pass a success_threshold above that, or name a flag of success: "
                "keys=Keys(success=...).",
                stacklevel=2,
            )
            self._goalless = None


def _any_multi_step(transform: Transform) -> bool:
    """Returns whether the pipeline that a transform is part of holds a ``MultiStepTransform``."""
    while (reference := transform.__dict__.get("_container")) is not None and reference() is not None:
        transform = reference()
    return any(isinstance(part, MultiStepTransform) for part in transform.modules())
