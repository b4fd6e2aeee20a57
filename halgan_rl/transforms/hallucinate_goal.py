"""The second step of the sample path: painting the goal into the images."""

from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from halgan_rl.keys import Keys, dotted
from halgan_rl.transforms.base import ReplayTransform
from halgan_rl.transforms.rows import replace_rows

SEEN = 16
"""How much some value of an image must change for the goal to be seen; shipped generators' blur seldom changes more."""


class Hallucinator(Protocol):
    """Paints the goal into images as it would be seen from their poses.

    One that paints images of one shape only says so in an attribute ``image_shape``, such as ``(64, 64, 3)``. Then
    other images are refused when they are written.
    """

    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Paint one goal into the F images of each of N rows.

        Args:
            pixels: uint8 ``[N, F, H, W, C]``; not modified.
            pose: float ``[N, F, P]``, from where each image was taken.
            goal_pose: float ``[N, 1, P]``, from where the goal is reached.

        Returns:
            uint8, of the shape and on the device of ``pixels``.
        """


class HallucinateGoal(ReplayTransform):
    """Edits the images of relabelled rows so that the goal is seen in them.

    **Core rule.** Where ``(goal, "mask")`` is True, the images at t and t+1 are replaced by what the hallucinator makes
    of them, seen from the poses at t and t+1, with the one goal pose; both in one call, so that they show one and the
    same goal. Other rows stay as they are, bit for bit. With ``pursue_unseen=False`` so do those whose image at t does
    not show the goal, and their mask becomes False.

    A robot that does not see its goal cannot know where it is. In hindsight the goal always lies where the robot went,
    however often it went there in vain: so rows with unseen goals teach it to go there again, such as into a corner.

    Hallucination is costly, so only masked rows are gathered and edited. ``fixed_shape=True`` edits all rows and
    selects by the mask, for CUDA graphs and ``torch.compile``. Both give equal results if a row's hallucination depends
    on that row only; one that draws latents draws others for other batch sizes.

    Images are uint8, height, width, channels. Others are refused when rows are written. Frames are stacked along the
    channels, by :class:`torchrl.envs.CatFrames` with ``dim=-1``, and the hallucinator must know that they are.

    The hallucinator is no submodule: its weights stay out of ``state_dict()`` and its train or eval mode is its own.

    Args:
        hallucinator: Maps pixels uint8 ``[N, 2, H, W, C]``, pose ``[N, 2, P]`` and goal pose ``[N, 1, P]`` to pixels.

    Keyword Args:
        pursue_unseen: Whether rows stay relabelled whose image at t does not show the goal, as in the paper. Seen is a
            goal for which some value changes by more than ``SEEN`` of 255, so not one of its background's colour.
        fixed_shape: Whether to hallucinate all rows, so that no shape depends on the data.
        keys: Where rows keep what.

    Raises:
        TypeError: If the hallucinator is not callable.
        ValueError: On writing, if images are not uint8, or of another shape than the hallucinator's or height, width,
            channels; on sampling, if the hallucinator returns another shape or dtype than it was given.
        KeyError: On writing and sampling, if a row lacks a key; names the key and the field of ``keys`` that set it.

    Examples:
        >>> from tensordict import TensorDict
        >>> black = torch.zeros(2, 4, 4, 3, dtype=torch.uint8)
        >>> frame = TensorDict({"pixels": black, "pose": torch.zeros(2, 3)}, batch_size=[2])
        >>> goal = {"mask": torch.tensor([[True], [False]]), "pose": torch.ones(2, 3)}
        >>> rows = frame.clone().update({"next": frame, "goal": goal})
        >>> rows = HallucinateGoal(lambda pixels, pose, goal_pose: pixels + 9)(rows)
        >>> rows["next", "pixels"].amax((1, 2, 3)).tolist()
        [9, 0]
    """

    hallucinator: Hallucinator

    def __init__(
        self,
        hallucinator: Hallucinator,
        *,
        pursue_unseen: bool = True,
        fixed_shape: bool = False,
        keys: Keys = Keys(),
    ) -> None:
        super().__init__(keys)
        if not callable(hallucinator):
            raise TypeError(f"hallucinator must be callable on (pixels, pose, goal_pose), got {hallucinator!r}.")
        self.__dict__["hallucinator"] = hallucinator  # past nn.Module, which would register it
        self.pursue_unseen = pursue_unseen
        self.fixed_shape = fixed_shape

    def _check_written(self, rows: TensorDictBase) -> None:
        """Refuses images that the hallucinator could not paint."""
        shapes = []
        for key in (self.keys.pixels, self.keys.next("pixels")):
            pixels, name = self._read(rows, "pixels", key), f"{type(self).__name__}: the entry {dotted(key)}"
            if pixels.dtype != torch.uint8:
                raise ValueError(
                    f"{name} is {pixels.dtype}, but images must be uint8, 0 to 255, as they are rendered: write "
                    "them before they are scaled, without ToTensorImage, or convert: (255 * pixels).round().byte()."
                )
            shapes.append(tuple(pixels.shape[rows.batch_dims :]))
            _check_image_shape(shapes[-1], name, self.image_shape)
        if shapes[0] != shapes[1]:
            raise ValueError(f"{name} has images {shapes[1]}, but {dotted(self.keys.pixels)} has {shapes[0]}.")

    @property
    def image_shape(self) -> tuple[int, ...] | None:
        """The only shape of images that the hallucinator paints; None if it does not say."""
        shape = getattr(self.hallucinator, "image_shape", None)
        return None if shape is None else tuple(shape)

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Paints the goal into the images of relabelled rows ``[...]``."""
        mask = self._read(tensordict, "goal", self.keys.goal_mask)
        goal_pose = self._read(tensordict, "goal", self.keys.goal_pose)
        pose = self._read(tensordict, "pose"), self._read_next(tensordict, "pose")
        pixels = self._read(tensordict, "pixels"), self._read_next(tensordict, "pixels")
        edit = self._edit_all if self.fixed_shape else self._edit_masked
        rows = (entry.reshape(-1, *entry.shape[tensordict.batch_dims :]) for entry in (*pixels, *pose, goal_pose))
        relabelled, *edited = edit(mask.flatten(), *rows)
        tensordict.set(self.keys.goal_mask, relabelled.reshape(mask.shape))
        for key, before, after in zip((self.keys.pixels, self.keys.next("pixels")), pixels, edited, strict=True):
            tensordict.set(key, after.reshape(before.shape))
        return tensordict

    def _edit_masked(
        self, mask: Tensor, pixels: Tensor, next_pixels: Tensor, *poses: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Hallucinates the masked ones of N rows only; returns the mask and both images."""
        index = mask.nonzero().squeeze(-1)
        if len(index) == 0:
            return mask, pixels, next_pixels
        rows = [entry.index_select(0, index) for entry in (pixels, next_pixels, *poses)]
        root, following = self._hallucinate(*rows)
        if not self.pursue_unseen:
            seen = _differ(rows[0], root).nonzero().squeeze(-1)
            index, root, following = (entry.index_select(0, seen) for entry in (index, root, following))
            mask = torch.zeros_like(mask).index_fill(0, index, True)
        return mask, replace_rows(pixels, index, root), replace_rows(next_pixels, index, following)

    def _edit_all(
        self, mask: Tensor, pixels: Tensor, next_pixels: Tensor, *poses: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Hallucinates all of N rows, then keeps the masked ones: the same shapes whatever the mask."""
        root, following = self._hallucinate(pixels, next_pixels, *poses)
        if not self.pursue_unseen:
            mask = mask & _differ(pixels, root)
        wide = mask.reshape(-1, *[1] * (pixels.ndim - 1))
        return mask, torch.where(wide, root, pixels), torch.where(wide, following, next_pixels)

    def _hallucinate(
        self, pixels: Tensor, next_pixels: Tensor, pose: Tensor, next_pose: Tensor, goal_pose: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Calls the hallucinator on both frames of each of N rows at once."""
        frames = torch.stack([pixels, next_pixels], dim=1)
        edited = self.hallucinator(frames, torch.stack([pose, next_pose], dim=1), goal_pose.unsqueeze(1))
        if edited.shape != frames.shape or edited.dtype != frames.dtype:
            raise ValueError(
                f"The hallucinator {self.hallucinator!r} must return pixels like those it was given, "
                f"{frames.dtype} {tuple(frames.shape)}, but returned {edited.dtype} {tuple(edited.shape)}."
            )
        return edited[:, 0], edited[:, 1]


def _check_image_shape(shape: tuple[int, ...], name: str, wanted: tuple[int, ...] | None = None) -> None:
    """Refuses what is no image ``[H, W, C]``.

    Args:
        shape: What to check.
        name: What it is the shape of, for people.
        wanted: The only shape to accept; None for any height, width and channels.

    Raises:
        ValueError: Names the shape and the remedy.
    """
    if wanted is not None:
        if shape != wanted:
            raise ValueError(
                f"{name} has images {shape}, but this hallucinator paints {wanted}: render or resize them so, or take "
                "a hallucinator that was made for them."
            )
        return
    if len(shape) != 3:
        raise ValueError(
            f"{name} has images {shape}, but they must be height, width, channels. Stack frames along the channels: "
            "CatFrames(N, dim=-1). Give grey images a channel: UnsqueezeTransform(-1). Or give the hallucinator an "
            "attribute image_shape if it paints such images."
        )
    if shape[2] > min(shape[:2]):
        raise ValueError(
            f"{name} has images {shape}, which look like channels, height, width; the channels must come last: append "
            "PermuteTransform(dims=(-2, -1, -3)) to the environment, or give the hallucinator an attribute image_shape "
            "if it paints such images."
        )


def _differ(before: Tensor, after: Tensor) -> Tensor:
    """Returns which images uint8 ``[N, ...]`` differ by more than ``SEEN``."""
    return (torch.maximum(before, after) - torch.minimum(before, after)).flatten(1).amax(1) > SEEN
