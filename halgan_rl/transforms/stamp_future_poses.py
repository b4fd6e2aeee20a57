"""The write path of hindsight: every row learns where its episode went next."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from halgan_rl.keys import Keys, dotted
from halgan_rl.poses import PlanarPoses, Poses, short
from halgan_rl.transforms.base import ReplayTransform
from halgan_rl.transforms.unfinished_episode import Steps, UnfinishedEpisode, concatenate, future_poses


class StampFuturePoses(ReplayTransform):
    """Stamps on each row, as it is written, the poses that its episode visits next.

    **Core rule.** Row t gets ``(hindsight, "pose")``, the poses at t+1 ... t+D, and ``(hindsight, "horizon")``, how
    many of them may serve as a goal in hindsight: those before any positive reward, any termination and the end of the
    episode. The last pose of an episode cut by its time limit is a usable goal; that of one that ended by success is
    not. Where the flags of the pose change, a stage of the task is completed, as at a pick-up: that pose is a usable
    goal, the last one. Horizon 0 means that the row is never relabelled. Beyond the episode's end its last pose is
    repeated.

    A row is held back until D steps or its episode's end are known, so at most D - 1 rows an environment wait here, and
    an extension of the buffer may write fewer rows than it was given, or none. Use ``extend``, with rows in order of
    time: ``[T]`` for one environment, ``[E, T]`` for several (time last, as TorchRL's collectors give them). What
    reaches the storage is flat, ``[N]``, one environment after the other, so the storage must be one-dimensional (its
    default). Any sampler, storage and writer will do: a row carries all that hindsight asks of it, also after the ring
    has wrapped. (A sampler of slices finds unbroken trajectories only if one environment writes.)

    Rows held back are part of ``state_dict()``, hence of a buffer's checkpoint. :meth:`flush` releases them early.
    Rows that already carry both hindsight keys, such as those from :meth:`flush`, pass through as they are.

    Args:
        max_distance: D, the furthest goal in steps (the paper's longest failed snippet: 32 for Navigate).

    Keyword Args:
        poses: What the entries of a pose mean.
        keys: Where rows keep what.

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
        poses: Poses = PlanarPoses(),  # noqa: B008 (frozen)
        keys: Keys = Keys(),  # noqa: B008 (frozen)
    ) -> None:
        super().__init__(keys)
        if max_distance < 1:
            raise ValueError(f"max_distance must be at least 1 step, got {max_distance}.")
        self.max_distance = max_distance
        self.poses = poses
        self._waiting: list[UnfinishedEpisode] = []  # one an environment

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leaves sampled rows as they are: all the work is done when rows are written."""
        return tensordict

    @torch.no_grad()
    def _inv_call(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        """Takes new rows ``[T]`` or ``[E, T]``; returns those whose future is now known, flat, or None."""
        if tensordict is None or 0 in tensordict.batch_size:
            return None
        if self._is_stamped(tensordict):
            return tensordict
        rows = self._by_environment(tensordict)
        steps = self._read_steps(rows)
        waiting = self._waiting or [UnfinishedEpisode() for _ in range(len(rows))]
        self._check_continuity(steps, waiting)
        self._waiting = waiting
        ready = [self._stamp(waiting[e], rows[e], Steps(*(entry[e] for entry in steps))) for e in range(len(rows))]
        return concatenate([chunk for chunks in ready for chunk in chunks])

    def flush(self) -> TensorDictBase | None:
        """Releases the rows held back, stamped with the future that is known so far.

        For the end of a run, or before the environments are reset in mid-episode: write what this returns with
        ``replay_buffer.extend``, which leaves stamped rows as they are.

        Returns:
            Rows ``[N]``, or None if none were held back.
        """
        ready = [self._release(waiting, waiting.count) for waiting in self._waiting]
        self._waiting = []
        return concatenate([chunk for chunks in ready for chunk in chunks])

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the rows held back, as plain dictionaries of tensors, one an environment."""
        states: list[dict[str, Any] | None] = []
        for waiting in self._waiting:
            rows = concatenate(list(waiting.chunks))
            states.append(None if rows is None else {"count": len(rows), "rows": rows.to_dict()})
        return {"waiting": states}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`get_extra_state` returned."""
        self._waiting = [UnfinishedEpisode() for _ in state["waiting"]]
        for waiting, saved in zip(self._waiting, state["waiting"], strict=True):
            if saved is not None:
                rows = TensorDict.from_dict(saved["rows"], batch_size=[saved["count"]])
                waiting.append(rows, self._read_steps(rows))

    def _is_stamped(self, tensordict: TensorDictBase) -> bool:
        keys = tensordict.keys(True, True)
        return self.keys.hindsight_pose in keys and self.keys.hindsight_horizon in keys

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

    def _read_steps(self, rows: TensorDictBase) -> Steps:
        """Reads what hindsight needs to know of each row, ``[..., T]``."""
        done = self._read_next(rows, "done").reshape(rows.shape)
        terminated = self._read_next(rows, "terminated").reshape(rows.shape)
        reward = self._read_next(rows, "reward").reshape(rows.shape)
        pose, next_pose = self._read(rows, "pose"), self._read_next(rows, "pose")
        self.poses.check(pose, f"{type(self).__name__}: the entry {dotted(self.keys.pose)}")
        self.poses.check(next_pose, f"{type(self).__name__}: the entry {dotted(self.keys.next('pose'))}")
        turned = self.poses.stage_changed(pose, next_pose)
        return Steps(pose, next_pose, last=done | terminated, solved=terminated | (reward > 0), turned=turned)

    def _check_continuity(self, steps: Steps, waiting: list[UnfinishedEpisode]) -> None:
        """Refuses rows that start elsewhere than where the row before them, in the same episode, ended.

        Such rows are not one environment's consecutive steps, and a goal could cross from one episode into another.
        """
        jump = (steps.pose[:, 1:] != steps.next_pose[:, :-1]).any(-1) & ~steps.last[:, :-1]
        found = [(e, t + 1) for e, t in jump.nonzero().tolist()]
        for e, held in enumerate(waiting):
            if held.count and not torch.equal(held.steps.next_pose[-1], steps.pose[e, 0]):
                found.insert(0, (e, 0))
        if found:
            environment, time = found[0]
            raise ValueError(
                f"Row {time} of environment {environment} starts at {short(steps.pose[environment, time])}, not "
                "where the row before it ended, though that one did not end an episode. Rows must be consecutive "
                "steps, [T] or [E, T]: stack several workers' rows rather than joining them (cat_results='stack'), and "
                "before a reset in mid-episode write the rows held back: replay_buffer.extend(transform.flush())."
            )

    def _stamp(self, waiting: UnfinishedEpisode, rows: TensorDictBase, steps: Steps) -> list[TensorDictBase]:
        """Adds one environment's new rows ``[T]`` to those held back and releases those whose future is known."""
        waiting.append(rows, steps)
        released = self._release(waiting, waiting.count_known(self.max_distance))
        waiting.own_last_chunk()
        return released

    def _release(self, waiting: UnfinishedEpisode, count: int) -> list[TensorDictBase]:
        """Takes the first ``count`` rows off those held back, with their hindsight stamped on them."""
        if count == 0:
            return []
        poses, horizons = future_poses(waiting.steps, count, self.max_distance)
        released, start = [], 0
        for chunk in waiting.pop(count):
            span = slice(start, start := start + len(chunk))
            chunk.set(self.keys.hindsight_pose, poses[span])
            chunk.set(self.keys.hindsight_horizon, horizons[span])
            released.append(chunk)
        return released
