"""What rows must be so that each one's future can be read off those after it."""

import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDictBase
from torch import Tensor

from halgan_rl.keys import dotted
from halgan_rl.poses import Poses, short
from halgan_rl.transforms.unfinished_episode import Layout, Steps, UnfinishedEpisode

MASKS: tuple[NestedKey, ...] = (("collector", "mask"), "mask")
"""Where TorchRL's ``split_trajectories`` says which rows are no padding."""


def layout_of(rows: TensorDictBase) -> Layout:
    """Returns what the rows ``[..., T]`` hold."""
    dims = rows.batch_dims
    return {key: (value.dtype, value.shape[dims:]) for key, value in rows.items(True, True)}


def dense(rows: TensorDictBase) -> TensorDictBase:
    """Returns the rows, stacked at last if they are a lazy stack, as a collector gives them to a buffer.

    A part of a lazy stack shares its rows with the whole: setting an entry on the one would set it on the other.
    """
    lazy = any(isinstance(part, LazyStackedTensorDict) for part in (rows, *rows.values()))
    return rows.contiguous() if lazy else rows


def check_layout(layout: Layout, waiting: list[UnfinishedEpisode]) -> None:
    """Refuses rows with other entries than those held back, together with which they will be written."""
    held = next((each.layout for each in waiting if each.count), layout)
    if held == layout:
        return
    if held.keys() != layout.keys():
        added, lacking = (
            ", ".join(sorted(map(dotted, one.keys() - other.keys()))) or "nothing"
            for one, other in ((layout, held), (held, layout))
        )
        raise KeyError(
            f"These rows have {added} and lack {lacking}, unlike those before them, some of which are held back: write "
            "the same entries always. If those before them were wrong, forget them: transform.drop_held_rows()."
        )
    key = next(key for key in held if held[key] != layout[key])
    (dtype, shape), (new_dtype, new_shape) = held[key], layout[key]
    raise ValueError(
        f"In these rows {dotted(key)} is {new_dtype} {tuple(new_shape)}, in those before them, some of which are held "
        f"back, {dtype} {tuple(shape)}: write one dtype and shape only. If those before them were wrong, forget them: "
        "transform.drop_held_rows()."
    )


def check_unpadded(rows: TensorDictBase) -> None:
    """Refuses trajectories that are padded with zeros to one length: zeros are no steps."""
    for key in MASKS:
        mask = rows.get(key, None)
        if mask is None or mask.dtype != torch.bool or mask.numel() != rows.numel():
            continue  # another kind of mask, such as one of actions
        padding = int(mask.numel() - mask.sum())
        if padding:
            raise ValueError(
                f"{padding} of these {rows.numel()} rows are padding: their mask, {dotted(key)}, is False. Write rows "
                "as collectors give them without split_trajs=True (or do not call split_trajectories): episodes may "
                "follow one another in time, [T] or [E, T]."
            )


def check_continuity(steps: Steps, waiting: list[UnfinishedEpisode]) -> None:
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


def check_reach(pose: Tensor, next_pose: Tensor, poses: Poses, max_step: float) -> None:
    """Refuses rows ``[E, T]`` whose two poses are further apart than a step can lead: they are of two episodes."""
    far = poses.travelled(pose, next_pose) > max_step
    if far.any():
        environment, time = far.nonzero()[0].tolist()
        raise ValueError(
            f"Row {time} of environment {environment} leads from {short(pose[environment, time])} to "
            f"{short(next_pose[environment, time])}, further than max_step={max_step} m. If a step may lead so far, "
            "raise max_step. Otherwise the row's next observation belongs to another episode, as in vectorised "
            "Gymnasium environments that reset themselves: step the environments one by one, in TorchRL's SerialEnv "
            "or ParallelEnv."
        )
