"""A generator's output, tabulated: hallucination for the price of a lookup."""

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from halgan_rl.hallucinators import check_poses
from halgan_rl.models.halgan import HallucinationGenerator
from halgan_rl.models.pixels import to_float, to_uint8
from halgan_rl.poses import relative_pose

VISIBLE = 2
"""A pixel is kept if it changes a black or a white image by more than this [levels of 255]."""


BLOCK = 512
"""Cells whose whole images are held at a time."""


@dataclass(frozen=True)
class BankGrid:
    """Where a generator is asked what it paints.

    The cells are spaced evenly in the image, not in the room: in bearing, and in the *inverse* of the distance, by
    which a goal on the floor grows and sinks as it comes near.

    Attributes:
        goal_offset: the goal stands this far ahead of the goal pose [m]. Turning the goal pose about the goal then
            changes little but which side of it is seen, and one yaw is enough; with 0 for want of a better one, ask
            for many yaws.
        nearest: of the goal, from the robot [m]; what is nearer is painted as if it were that far.
        farthest: likewise.
        widest: bearing beyond which the goal is out of sight, to either side [rad]; nothing is painted there.
        distances: cells from nearest to farthest.
        bearings: cells from right to left.
        yaws: cells of the goal's yaw, all around.
        latents: how many goals to choose from; each row of a batch is shown one of them.

    Raises:
        ValueError: if a length, angle or count is out of range.
    """

    goal_offset: float
    nearest: float = 0.1
    farthest: float = 6.0
    widest: float = pi / 4
    distances: int = 64
    bearings: int = 64
    yaws: int = 1
    latents: int = 4

    def __post_init__(self) -> None:
        if not 0 < self.nearest < self.farthest:
            raise ValueError(f"need 0 < nearest < farthest, got {self.nearest} and {self.farthest} m")
        if not 0 < self.widest <= pi:
            raise ValueError(f"widest={self.widest} rad must lie in (0, pi]")
        if self.goal_offset < 0:
            raise ValueError(f"goal_offset={self.goal_offset} m must not be negative: the goal stands ahead")
        if min(self.distances, self.bearings) < 2 or min(self.yaws, self.latents) < 1:
            raise ValueError(
                "need at least 2 distances and bearings, 1 yaw and 1 latent, got "
                f"{self.distances}, {self.bearings}, {self.yaws} and {self.latents}"
            )

    @property
    def cells(self) -> int:
        """Cells of one latent."""
        return self.distances * self.bearings * self.yaws

    def relative_poses(self) -> Tensor:
        """Return the relative goal pose at the centre of each cell, ``[cells, 3]``."""
        inverse = torch.linspace(1 / self.nearest, 1 / self.farthest, self.distances)
        bearing = torch.linspace(-self.widest, self.widest, self.bearings)
        yaw = torch.arange(self.yaws) * (2 * pi / self.yaws)
        inverse, bearing, yaw = (axis.flatten() for axis in torch.meshgrid(inverse, bearing, yaw, indexing="ij"))
        x = bearing.cos() / inverse - self.goal_offset * yaw.cos()
        y = bearing.sin() / inverse - self.goal_offset * yaw.sin()
        return torch.stack([x, y, yaw], -1)

    def cells_at(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """Return the cells nearest to relative goal poses ``[..., 3]``, int64 ``[...]``, and which are in sight."""
        x, y, yaw = relative.unbind(-1)
        x, y = x + self.goal_offset * yaw.cos(), y + self.goal_offset * yaw.sin()
        bearing, inverse = torch.atan2(y, x), 1 / torch.hypot(x, y).clamp(self.nearest, self.farthest)
        steps = (self.distances - 1) / (1 / self.nearest - 1 / self.farthest)
        row = ((1 / self.nearest - inverse) * steps).round()
        column = ((bearing + self.widest) * ((self.bearings - 1) / (2 * self.widest))).round()
        turn = (yaw * (self.yaws / (2 * pi))).round() % self.yaws
        in_sight = bearing.abs() <= self.widest
        cell = (row * self.bearings + column.clamp(0, self.bearings - 1)) * self.yaws + turn
        return cell.to(torch.int64), in_sight


class HallucinationBank:
    """Paints goals by looking up what a generator painted before.

    A generator's output depends on the relative goal pose and a latent only, never on the image. So it is asked once
    for each cell of a grid, and of its answers only the pixels are kept in which something is to be seen: a sparse
    matrix with a row for each cell, 8 bits a value. A hallucination is then a lookup, over twenty times as fast.

    The same interface as :class:`~halgan_rl.hallucinators.GanHallucinator`, and the same goal in all images of a row.

    Args:
        generator: the trained network; its train or eval mode is left as it was found.
        grid: where to ask it.
        rng: draws the latents to keep, and later which of them a row is shown.
        chunk: images of one pass of the generator.

    Attributes:
        cells: rows of the table: the grid's cells, for each latent and each setting of the pose's flags.
        nbytes: size of the table [bytes].

    Raises:
        ValueError: if the generator changes pixels where it paints nothing, as tanh(s + H) does; and, when called, if
            poses have another size than those that the network was trained with, or are not finite.

    Examples:
        >>> from halgan_rl.models import CoordinateGenerator
        >>> grid = BankGrid(goal_offset=0.0, distances=4, bearings=4, yaws=2, latents=1)
        >>> bank = HallucinationBank(CoordinateGenerator(), grid, rng=torch.Generator().manual_seed(0))
        >>> bank(torch.zeros(5, 2, 64, 64, 3, dtype=torch.uint8), torch.zeros(5, 2, 3), torch.ones(5, 1, 3)).shape
        torch.Size([5, 2, 64, 64, 3])
    """

    def __init__(
        self, generator: HallucinationGenerator, grid: BankGrid, *, rng: torch.Generator, chunk: int = 4
    ) -> None:
        self._generator, self._grid, self._rng = generator, grid, rng
        self._pose_size = int(generator.arguments["pose_size"])
        self._flags = 2 ** (self._pose_size - 3)
        self.cells = grid.latents * self._flags * grid.cells
        was_training = generator.training
        generator.eval()
        try:
            self._check_composition()
            self._tabulate(chunk)
        finally:
            generator.train(was_training)

    @property
    def nbytes(self) -> int:
        """Size of the table [bytes]."""
        return sum(part.nbytes for part in (self._starts, self._places, self._changes))

    @torch.no_grad()
    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Paint the goals, see :class:`~halgan_rl.hallucinators.Hallucinator`."""
        check_poses(self._pose_size, pose=pose, goal_pose=goal_pose)
        cells = self._cells_at(pose, goal_pose).flatten()
        counts = self._starts[cells + 1] - self._starts[cells]
        images = torch.repeat_interleave(counts)
        first = counts.cumsum(0) - counts
        entries = torch.arange(len(images)) + (self._starts[cells] - first)[images]
        places = images * (pixels.shape[-3] * pixels.shape[-2]) + self._places.index_select(0, entries)
        change = self._changes.index_select(0, entries).to(torch.float32).div_(127)
        flat = pixels.reshape(-1, 3)
        before = to_float(flat.index_select(0, places)[:, None, None])  # each pixel an image of its own
        after = to_uint8(self._generator.compose(before, change[:, :, None, None]))
        return flat.index_copy(0, places, after[:, 0, 0]).view(pixels.shape)

    def _cells_at(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Return the rows of the table ``[N, F]`` for poses ``[N, F, P]`` and goals ``[N, 1, P]``; one latent a row."""
        cell, in_sight = self._grid.cells_at(relative_pose(pose, goal_pose))
        powers = 2 ** torch.arange(self._pose_size - 3)
        flags = ((pose[..., 3:] > 0.5) * powers).sum(-1)
        latent = torch.randint(self._grid.latents, (len(pose), 1), generator=self._rng)
        return torch.where(in_sight, (latent * self._flags + flags) * self._grid.cells + cell, self.cells)

    @torch.no_grad()
    def _tabulate(self, chunk: int) -> None:
        """Ask the generator for every cell, and keep what is to be seen of its answers."""
        generator, rng = self._generator, self._rng
        features = generator.encoding(generator.encoding.labels(*self._poses()))
        counts, places, changes = [], [], []
        for latent in generator.sample_latent(self._grid.latents, rng):
            for block in features.split(BLOCK):
                change = self._ask(block, latent, chunk)
                visible = torch.cat([self._visible(part) for part in change.split(chunk)])
                counts.append(visible.sum(1))
                places.append(visible.nonzero()[:, 1].to(torch.int16))
                changes.append(change[visible])
        self._starts = torch.cat(
            [torch.zeros(1, dtype=torch.int64), *counts, torch.zeros(1, dtype=torch.int64)]
        ).cumsum(0)
        self._places, self._changes = torch.cat(places), torch.cat(changes)

    def _ask(self, features: Tensor, latent: Tensor, chunk: int) -> Tensor:
        """Return what the generator paints, int8 ``[N, H * W, C]``; in one tensor, or the heap falls to pieces."""
        changes = torch.empty(0)
        for first in range(0, len(features), chunk):
            part = features[first : first + chunk]
            change = self._generator(part, latent.expand(len(part), -1)).flatten(2).transpose(1, 2)
            if first == 0:
                changes = torch.empty(len(features), *change.shape[1:], dtype=torch.int8)
            torch.round(change * 127, out=change)
            changes[first : first + chunk] = change
        return changes

    def _poses(self) -> tuple[Tensor, Tensor]:
        """Return poses at the origin, with all settings of the flags, and the goal poses to see from there."""
        relative = self._grid.relative_poses()
        bits = 2 ** torch.arange(self._pose_size - 3)
        flags = (torch.arange(self._flags)[:, None] & bits).bool().float().repeat_interleave(len(relative), 0)
        pose = torch.cat([torch.zeros(len(flags), 3), flags], -1)
        return pose, torch.cat([relative.repeat(self._flags, 1), flags], -1)

    def _visible(self, change: Tensor) -> Tensor:
        """Return which pixels of changes int8 ``[N, H * W, C]`` black and white images would show, ``[N, H * W]``."""
        changes = change.flatten(0, 1)[:, :, None, None] / 127
        visible = torch.zeros(len(changes), dtype=torch.bool)
        for level in (-1.0, 1.0):
            image = torch.full((1, 3, 1, 1), level)
            shown = self._generator.compose(image, changes) - image
            visible |= shown.abs().amax((1, 2, 3)) > VISIBLE / 127.5
        return visible.view(change.shape[:2])

    def _check_composition(self) -> None:
        image, generator = torch.full((1, 3, 1, 1), 0.5), self._generator
        change = generator(torch.zeros(1, generator.encoding.size), torch.zeros(1, generator.latent_size))
        if not torch.allclose(generator.compose(image, torch.zeros_like(change[..., :1, :1])), image):
            raise ValueError(
                f"{type(generator).__name__} changes pixels where it paints nothing, all of which a bank would have to "
                'keep: use one that is the identity there, such as the paper\'s with composition="difference", or ask '
                "the generator each time (GanHallucinator; --no-bank in the recipes)"
            )
