"""The write path of hindsight: every row learns where its episode went next."""

from collections import deque
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor

from halgan_rl.poses import check_pose_size
from halgan_rl.transforms.base import ReplayTransform, next_key


class StampFuturePoses(ReplayTransform):
    """Stamps on each row, as it is written, the poses that its episode visits next.

    **Core rule.** Row t gets ``(hindsight, "pose")``, the poses at t+1 ... t+D, and ``(hindsight, "horizon")``, how
    many of them may serve as a goal in hindsight: those before any positive reward, any termination and the end of the
    episode. The last pose of an episode cut by its time limit is a usable goal; that of one that ended by success is
    not. Horizon 0 means that the row is never relabelled. Beyond the episode's end its last pose is repeated.

    A row is held back until D steps or its episode's end are known, so at most D - 1 rows an environment wait here, and
    an extension of the buffer may write fewer rows than it was given, or none. Use ``extend``, with rows in order of
    time: ``[T]`` for one environment, ``[E, T]`` for several (time last, as TorchRL's collectors give them). What
    reaches the storage is flat, ``[N]``, one environment after the other, so the storage must be one-dimensional (its
    default). Any sampler, storage and writer will do: a row carries all that hindsight asks of it, also after the ring
    has wrapped.

    Rows held back are part of ``state_dict()``, hence of a buffer's checkpoint. :meth:`flush` releases them early.
    Rows that already carry both hindsight keys, such as those from :meth:`flush`, pass through as they are.

    Args:
        max_distance: D, the furthest goal in steps (the paper's longest failed snippet: 32 for Navigate).

    Keyword Args:
        pose_key: Pose ``[P]``, P >= 3, x [m], y [m], yaw [rad], flags. Read at the root and under ``"next"``.
        reward_key: Reward ``[1]``, read under ``"next"``.
        done_key: End-of-episode flag ``[1]``, read under ``"next"``.
        terminated_key: Termination flag ``[1]``, read under ``"next"``.
        hindsight_key: Where ``"pose"`` ``[D, P]`` and ``"horizon"`` ``[1]`` int64 are written.

    Raises:
        ValueError: If ``max_distance`` is less than 1; on writing, if a pose is not finite or of the wrong size, or if
            rows are not consecutive steps (see :meth:`_check_continuity`). Such a batch is refused whole.
        KeyError: On writing, if a row lacks a key; names the key and the argument that set it.

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
        pose_key: NestedKey = "pose",
        reward_key: NestedKey = "reward",
        done_key: NestedKey = "done",
        terminated_key: NestedKey = "terminated",
        hindsight_key: NestedKey = "hindsight",
    ) -> None:
        super().__init__()
        if max_distance < 1:
            raise ValueError(f"max_distance must be at least 1 step, got {max_distance}.")
        self.max_distance = max_distance
        self.pose_key = pose_key
        self.reward_key = reward_key
        self.done_key = done_key
        self.terminated_key = terminated_key
        self.hindsight_key = hindsight_key
        self._waiting: list[_WaitingRows] = []  # one an environment

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves sampled rows as they are: all the work is done when rows are written."""
        return tensordict

    @torch.no_grad()
    def _inv_call(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        """Takes new rows ``[T]`` or ``[E, T]``; returns those whose future is now known, flat, or None."""
        if tensordict is None or self._is_stamped(tensordict):
            return tensordict
        rows = self._by_environment(tensordict)
        steps = self._read_steps(rows)
        waiting = self._waiting or [_WaitingRows() for _ in range(len(rows))]
        self._check_poses(steps, waiting)
        self._check_continuity(steps, waiting)
        self._waiting = waiting
        ready = [self._stamp(waiting[e], rows[e], _Steps(*(entry[e] for entry in steps))) for e in range(len(rows))]
        return _concatenate([chunk for chunks in ready for chunk in chunks])

    def flush(self) -> TensorDictBase | None:
        """Releases the rows held back, stamped with the future that is known so far.

        For the end of a run, or before the environments are reset in mid-episode: write what this returns with
        ``replay_buffer.extend``, which leaves stamped rows as they are.

        Returns:
            Rows ``[N]``, or None if none were held back.
        """
        ready = [self._release(waiting, waiting.count) for waiting in self._waiting]
        self._waiting = []
        return _concatenate([chunk for chunks in ready for chunk in chunks])

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the rows held back, as plain dictionaries of tensors, one an environment."""
        states: list[dict[str, Any] | None] = []
        for waiting in self._waiting:
            rows = _concatenate(list(waiting.chunks))
            states.append(None if rows is None else {"count": len(rows), "rows": rows.to_dict()})
        return {"waiting": states}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`get_extra_state` returned."""
        self._waiting = [_WaitingRows() for _ in state["waiting"]]
        for waiting, saved in zip(self._waiting, state["waiting"], strict=True):
            if saved is not None:
                rows = TensorDict.from_dict(saved["rows"], batch_size=[saved["count"]])
                waiting.append(rows, self._read_steps(rows))

    def _is_stamped(self, tensordict: TensorDictBase) -> bool:
        keys = tensordict.keys(True, True)
        return self._hindsight("pose") in keys and self._hindsight("horizon") in keys

    def _hindsight(self, name: str) -> NestedKey:
        return unravel_key((self.hindsight_key, name))

    def _by_environment(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the rows as ``[E, T]``."""
        if tensordict.batch_dims == 0:
            raise ValueError(
                "StampFuturePoses holds rows back and cannot take them through add(): "
                "write them with replay_buffer.extend(row.unsqueeze(0))."
            )
        rows = tensordict.reshape(-1, tensordict.batch_size[-1])
        if self._waiting and len(rows) != len(self._waiting):
            raise ValueError(
                f"These rows come from {len(rows)} environments (batch size {tuple(tensordict.batch_size)}), those "
                f"held back from {len(self._waiting)}. Write those first: replay_buffer.extend(transform.flush())."
            )
        return rows

    def _read_steps(self, rows: TensorDictBase) -> "_Steps":
        """Reads what hindsight needs to know of each row, ``[..., T]``."""
        done = self._read(rows, next_key(self.done_key), "done_key").reshape(rows.shape)
        terminated = self._read(rows, next_key(self.terminated_key), "terminated_key").reshape(rows.shape)
        reward = self._read(rows, next_key(self.reward_key), "reward_key").reshape(rows.shape)
        pose = self._read(rows, self.pose_key, "pose_key")
        next_pose = self._read(rows, next_key(self.pose_key), "pose_key")
        check_pose_size(pose, f"{type(self).__name__}: the entry {self.pose_key!r}")
        check_pose_size(next_pose, f"{type(self).__name__}: the entry {next_key(self.pose_key)!r}")
        return _Steps(pose, next_pose, last=done | terminated, solved=terminated | (reward > 0))

    def _check_poses(self, steps: "_Steps", waiting: list["_WaitingRows"]) -> None:
        """Refuses poses of another size than the pose they follow, and poses that are not finite."""
        size = next((held.steps.pose.shape[-1] for held in waiting if held.count), steps.pose.shape[-1])
        for pose, key in ((steps.pose, self.pose_key), (steps.next_pose, next_key(self.pose_key))):
            if pose.shape[-1] != size:
                raise ValueError(f"The entry {key!r} has {pose.shape[-1]} numbers, the pose before it {size}.")
            bad = ~torch.isfinite(pose).all(-1)
            if bad.any():
                environment, time = bad.nonzero()[0].tolist()
                raise ValueError(
                    f"The entry {key!r} is not finite: {pose[environment, time].tolist()} in row {time} of environment "
                    f"{environment}. No row of this batch was written. Mend the environment's pose observation."
                )

    def _check_continuity(self, steps: "_Steps", waiting: list["_WaitingRows"]) -> None:
        """Refuses rows that start elsewhere than where the row before them, in the same episode, ended.

        Such rows are not one environment's consecutive steps, and a goal could cross from one episode into another.
        """
        if steps.pose.shape[1] == 0:
            return
        jump = (steps.pose[:, 1:] != steps.next_pose[:, :-1]).any(-1) & ~steps.last[:, :-1]
        found = [(e, t + 1) for e, t in jump.nonzero().tolist()]
        for e, held in enumerate(waiting):
            if held.count and not torch.equal(held.steps.next_pose[-1], steps.pose[e, 0]):
                found.insert(0, (e, 0))
        if found:
            environment, time = found[0]
            raise ValueError(
                f"Row {time} of environment {environment} starts at {steps.pose[environment, time].tolist()}, not "
                "where the row before it ended, though that one did not end an episode. Rows must be consecutive "
                "steps, [T] or [E, T]: stack several workers' rows rather than joining them (cat_results='stack'), and "
                "before a reset in mid-episode write the rows held back: replay_buffer.extend(transform.flush())."
            )

    def _stamp(self, waiting: "_WaitingRows", rows: TensorDictBase, steps: "_Steps") -> list[TensorDictBase]:
        """Adds one environment's new rows ``[T]`` to those held back and releases those whose future is known."""
        waiting.append(rows, steps)
        ended = waiting.steps.last.nonzero()
        known = int(ended[-1]) + 1 if len(ended) else 0
        released = self._release(waiting, max(known, waiting.count - self.max_distance + 1, 0))
        waiting.own_last_chunk()
        return released

    def _release(self, waiting: "_WaitingRows", count: int) -> list[TensorDictBase]:
        """Takes the first ``count`` rows off those held back, with their hindsight stamped on them."""
        if count == 0:
            return []
        poses, horizons = future_poses(waiting.steps, count, self.max_distance)
        released, start = [], 0
        for chunk in waiting.pop(count):
            span = slice(start, start := start + len(chunk))
            chunk.set(self._hindsight("pose"), poses[span])
            chunk.set(self._hindsight("horizon"), horizons[span])
            released.append(chunk)
        return released


class _Steps(NamedTuple):
    """What hindsight needs to know of consecutive rows ``[..., T]`` of one environment."""

    pose: Tensor
    """``[..., T, P]`` pose at t."""
    next_pose: Tensor
    """``[..., T, P]`` pose at t+1."""
    last: Tensor
    """``[..., T]`` bool: the row ends its episode."""
    solved: Tensor
    """``[..., T]`` bool: the row earned a positive reward or terminated, so its next pose is no failure's."""


def future_poses(steps: _Steps, count: int, max_distance: int) -> tuple[Tensor, Tensor]:
    """Returns the future of the first ``count`` of T consecutive rows.

    Args:
        steps: The rows, ``[T]``.
        count: How many of them to stamp; those after them serve as their future only.
        max_distance: D, steps to look ahead.

    Returns:
        Poses ``[count, D, P]``, and the horizon ``[count, 1]`` int64: how many of them may serve as a goal.
    """
    total = len(steps.last)
    time = torch.arange(total, device=steps.last.device)
    end = _first_at_or_after(torch.where(steps.last, time, total - 1))[:count]
    solved = _first_at_or_after(torch.where(steps.solved, time, total))[:count]
    now = time[:count]
    horizon = torch.minimum(end + 1, solved).sub_(now).clamp_(max=max_distance)
    ahead = torch.arange(max_distance, device=now.device)
    poses = steps.next_pose[torch.minimum(now[:, None] + ahead, end[:, None])]
    return poses, horizon[:, None]


def _first_at_or_after(time: Tensor) -> Tensor:
    """Returns, for each position, the smallest entry from there on."""
    return time.flip(0).cummin(0).values.flip(0)


class _WaitingRows:
    """One environment's rows that are held back: a queue of chunks, so that images are not copied again and again."""

    def __init__(self) -> None:
        self.chunks: deque[TensorDictBase] = deque()
        self.steps: _Steps

    @property
    def count(self) -> int:
        return len(self.steps.last) if self.chunks else 0

    def append(self, rows: TensorDictBase, steps: _Steps) -> None:
        held = (self.steps, steps) if self.chunks else (steps,)
        self.steps = _Steps(*(torch.cat(entries) for entries in zip(*held, strict=True)))
        if len(rows):
            self.chunks.append(rows)

    def pop(self, count: int) -> list[TensorDictBase]:
        popped = []
        self.steps = _Steps(*(entry[count:].clone() for entry in self.steps))
        while count:
            chunk = self.chunks.popleft()
            if len(chunk) > count:
                self.chunks.appendleft(chunk[count:])
            popped.append(chunk[:count])
            count -= len(popped[-1])
        return popped

    def own_last_chunk(self) -> None:
        """Copies the newest rows: collectors may write their next batch into the same memory."""
        if self.chunks:
            self.chunks[-1] = self.chunks[-1].clone()


def _concatenate(chunks: list[TensorDictBase]) -> TensorDictBase | None:
    if not chunks:
        return None
    return chunks[0] if len(chunks) == 1 else torch.cat(chunks)
