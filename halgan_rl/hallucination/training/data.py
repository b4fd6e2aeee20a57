"""What generators are trained on: near-goal frames and failed ones, matched by the goal that is pursued in them."""

import torch
from torch import Tensor

from halgan_rl.hallucination.generators.base import HallucinationGenerator, ImageShape, check_pose_size
from halgan_rl.poses import PlanarPoses

Frames = dict[str, Tensor]
"""``pixels`` uint8 ``[N, H, W, C]``, ``pose`` ``[N, P]``; near-goal frames also ``goal_pose`` ``[N, P]``."""


def check_data(generator: HallucinationGenerator, near_goal: Frames, failed: Frames, poses: PlanarPoses) -> None:
    """Refuses frames that a generator cannot be trained on.

    Raises:
        KeyError: if an entry is missing; names it.
        ValueError: if images or poses are other than the generator's, or numbers of rows differ; names both shapes.
    """
    check_pose_size(generator, poses)
    for name, frames, entries in (
        ("near_goal", near_goal, ("pixels", "pose", "goal_pose")),
        ("failed", failed, ("pixels", "pose")),
    ):
        for entry in entries:
            if entry not in frames:
                raise KeyError(f"{name} lacks {entry!r}: it holds {sorted(frames)}.")
        check_images(f"{name}['pixels']", frames["pixels"], generator.image_shape)
        for entry in entries[1:]:
            poses.check(frames[entry], f"{name}[{entry!r}]")
            if frames[entry].shape[:-1] != frames["pixels"].shape[:1]:
                raise ValueError(
                    f"{name}[{entry!r}] is {list(frames[entry].shape)}, but there are {len(frames['pixels'])} images: "
                    "give one pose for each."
                )


def check_images(name: str, pixels: Tensor, image_shape: ImageShape) -> None:
    """Refuses images that are not those which a generator paints.

    Raises:
        ValueError: unless they are uint8 ``[N, *image_shape]``, N at least 1; names both shapes.
    """
    if pixels.dtype == torch.uint8 and tuple(pixels.shape[1:]) == image_shape and len(pixels):
        return
    height, width, channels = image_shape
    raise ValueError(
        f"{name} is {pixels.dtype} {list(pixels.shape)}, but the generator paints torch.uint8 "
        f"[N, {height}, {width}, {channels}] (images, height, width, channels), N at least 1: give it the "
        "image_shape and frame_stack of the frames; channels come last, levels are 0 to 255."
    )


def matching_settings(near_goal: Frames, failed: Frames, poses: PlanarPoses) -> tuple[Tensor, Tensor]:
    """Numbers the flags of near-goal poses and of failed ones, int64 ``[N]`` and ``[M]``, one number for each goal.

    Raises:
        ValueError: if there is a near-goal frame with flags that no failed frame has.
    """
    near, other = poses.setting(near_goal["pose"]), poses.setting(failed["pose"])
    lacking = set(near.tolist()) - set(other.tolist())
    if lacking:
        flags = poses.flags_of(torch.tensor(min(lacking))).tolist()
        raise ValueError(
            f"There are near-goal frames with the flags {flags}, but no failed ones to paint that goal into: "
            "collect failed frames with these flags as well."
        )
    return near, other
