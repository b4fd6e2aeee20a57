"""A generator's output, tabulated: a hallucination is then a lookup."""

from dataclasses import dataclass
from math import pi, prod

import torch
from torch import Tensor

from halgan_rl.hallucination.generators.base import HallucinationGenerator, ImageShape, check_pose_size
from halgan_rl.hallucination.hallucinators import check_pixels, check_poses
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms.rows import replace_rows

VISIBLE = 2
"""A line of the image is stored if it changes a black or a white image by more than this [levels of 255]."""

SHIFT = 7
WHOLE = 1 << SHIFT
"""A fraction of 1: the largest that leaves its product with a pixel's level within 16 bits."""

BLOCK = 512 * 64 * 64 * 3
"""Values of whole images that are held at a time."""


@dataclass(frozen=True)
class BankGrid:
    """Which views of a goal are tabulated.

    The cells are spaced evenly in the image, not in the room: in bearing, and in the *inverse* of the distance, by
    which a goal on the floor grows and sinks as it comes near. Where the poses know how far ahead of its goal pose the
    goal stands, turning the goal pose about the goal only changes which side of it is seen, and one yaw is
    enough. If they do not (``goal_offsets=(0.0,)``), many yaws are better.

    Attributes:
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

    nearest: float = 0.1
    farthest: float = 6.0
    widest: float = pi / 4
    distances: int = 64
    bearings: int = 64
    yaws: int = 1
    latents: int = 4

    def __post_init__(self) -> None:
        """Refuses values that make no sense."""
        if not 0 < self.nearest < self.farthest:
            raise ValueError(f"need 0 < nearest < farthest, got {self.nearest} and {self.farthest} m.")
        if not 0 < self.widest <= pi:
            raise ValueError(f"widest={self.widest} rad must lie in (0, pi].")
        if min(self.distances, self.bearings) < 2 or min(self.yaws, self.latents) < 1:
            raise ValueError(
                "need at least 2 distances and bearings, 1 yaw and 1 latent, got "
                f"{self.distances}, {self.bearings}, {self.yaws} and {self.latents}."
            )

    @property
    def cells(self) -> int:
        """Cells of one latent."""
        return self.distances * self.bearings * self.yaws

    def relative_poses(self, goal_offset: float) -> Tensor:
        """Returns the relative goal pose at the centre of each cell, ``[cells, 3]``.

        Args:
            goal_offset: how far ahead of its goal pose the goal stands [m].
        """
        inverse = torch.linspace(1 / self.nearest, 1 / self.farthest, self.distances)
        bearing = torch.linspace(-self.widest, self.widest, self.bearings)
        yaw = torch.arange(self.yaws) * (2 * pi / self.yaws)
        inverse, bearing, yaw = (axis.flatten() for axis in torch.meshgrid(inverse, bearing, yaw, indexing="ij"))
        x = bearing.cos() / inverse - goal_offset * yaw.cos()
        y = bearing.sin() / inverse - goal_offset * yaw.sin()
        return torch.stack([x, y, yaw], -1)

    def cells_at(self, pose: Tensor, goal_pose: Tensor, poses: PlanarPoses) -> tuple[Tensor, Tensor]:
        """Returns the cells nearest to goals as seen from poses, int64 ``[...]``, and which are in sight, bool.

        The cell of what is out of sight means nothing.

        Args:
            pose: ``[..., P]``.
            goal_pose: ``[..., P]``, broadcasts against ``pose``.
            poses: where the goals stand.
        """
        bearing, distance = poses.goal_polar(pose, goal_pose).unbind(-1)
        inverse = 1 / distance.clamp(self.nearest, self.farthest)
        steps = (self.distances - 1) / (1 / self.nearest - 1 / self.farthest)
        row = ((1 / self.nearest - inverse) * steps).round_()
        column = ((bearing + self.widest) * ((self.bearings - 1) / (2 * self.widest))).round_()
        cell = (row * self.bearings + column).to(torch.int64)
        if self.yaws > 1:
            turn = goal_pose[..., 2] - pose[..., 2]
            cell = cell * self.yaws + (turn * (self.yaws / (2 * pi))).round_().to(torch.int64) % self.yaws
        return cell, bearing.abs() <= self.widest


class HallucinationBank:
    """Paints goals by looking up what a generator painted before.

    A generator's output depends on the relative goal pose and a latent only, never on the image. So it is computed once
    for each cell of a grid. The output is a matte: each pixel keeps a fraction of what it was, and something is added.
    Only the image lines are stored in which something is to be seen, 8 bits a value. A hallucination is then a lookup
    and a little integer arithmetic.

    The same interface as :class:`~halgan_rl.hallucination.hallucinators.GeneratorHallucinator`.

    Args:
        generator: the trained network; its train or eval mode is left as it was found.
        grid: which views to tabulate.

    Keyword Args:
        poses: which entries of a pose are flags, and where the goals stand that they select.
        rng: draws the latents to keep, and later which of them a row is shown.
        share_latent: the images of a row share one latent, so that they show one and the same goal.
        chunk: images of one pass of the generator.

    Attributes:
        image_shape: height H, width W and channels C of the images that the generator paints.
        cells: rows of the table: the grid's cells, for each latent and each setting of the pose's flags.
        nbytes: size of the table [bytes].

    Raises:
        ValueError: if the generator's ``compose`` is no matte, as tanh(s + H) is not, or if it was trained with poses
            of another size; and, when called, if images or poses are other than those of its training, or poses are
            not finite.

    Examples:
        >>> from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
        >>> grid = BankGrid(distances=4, bearings=4, yaws=2, latents=1)
        >>> bank = HallucinationBank(CoordinateGenerator(), grid, rng=torch.Generator().manual_seed(0))
        >>> bank(torch.zeros(5, 2, 64, 64, 3, dtype=torch.uint8), torch.zeros(5, 2, 3), torch.ones(5, 1, 3)).shape
        torch.Size([5, 2, 64, 64, 3])
    """

    def __init__(
        self,
        generator: HallucinationGenerator,
        grid: BankGrid = BankGrid(),
        *,
        poses: PlanarPoses = PlanarPoses(),
        rng: torch.Generator,
        share_latent: bool = True,
        chunk: int = 4,
    ) -> None:
        check_pose_size(generator, poses)
        self._grid, self._poses, self._rng, self._share_latent = grid, poses, rng, share_latent
        self.image_shape: ImageShape = generator.image_shape
        self.cells = grid.latents * poses.settings * grid.cells
        was_training = generator.training
        generator.eval()
        try:
            _check_composition(generator)
            self._tabulate(generator, chunk)
        finally:
            generator.train(was_training)

    @property
    def nbytes(self) -> int:
        """Size of the table [bytes]."""
        return sum(part.nbytes for part in (self._spans, self._lines, self._mattes))

    @torch.no_grad()
    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Paints the goals, see :class:`~halgan_rl.hallucination.hallucinators.Hallucinator`."""
        check_pixels(self.image_shape, pixels)
        check_poses(self._poses.size, pose=pose, goal_pose=goal_pose)
        height, width, channels = self.image_shape
        # Which lines of the table belong to each image: spans of the table's entries, laid end to end.
        cells = self._cells_at(pose, goal_pose).flatten()
        starts, counts = self._spans.index_select(0, cells).unbind(1)
        images = torch.repeat_interleave(counts)
        entries = torch.arange(len(images)) + (starts + counts - counts.cumsum(0)).index_select(0, images)
        # The lines of the images that they change, [L, W, C].
        places = self._lines.index_select(0, entries) + images * height
        lines = pixels.reshape(-1, width, channels)
        kept, added = self._mattes.index_select(0, entries).to(torch.int16).unbind(1)
        after = lines.index_select(0, places).to(torch.int16).mul_(kept).add_(WHOLE // 2).bitwise_right_shift_(SHIFT)
        return replace_rows(lines, places, after.add_(added).clamp_(max=255).to(torch.uint8)).view(pixels.shape)

    def _cells_at(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Returns the rows of the table ``[N, F]`` for poses ``[N, F, P]`` and goals ``[N, 1, P]``."""
        setting = self._poses.setting(pose)
        cell, in_sight = self._grid.cells_at(pose, goal_pose, self._poses)
        latents_a_row = 1 if self._share_latent else pose.shape[1]
        latent = torch.randint(self._grid.latents, (len(pose), latents_a_row), generator=self._rng)
        return torch.where(in_sight, (latent * self._poses.settings + setting) * self._grid.cells + cell, self.cells)

    @torch.no_grad()
    def _tabulate(self, generator: HallucinationGenerator, chunk: int) -> None:
        """Computes the matte of every cell, and keeps the lines in which something is to be seen."""
        features = generator.encoding(generator.encoding.labels(*self._views()))
        counts, lines, mattes = [], [], []
        for latent in generator.sample_latent(self._grid.latents, self._rng):
            for block in features.split(max(1, BLOCK // prod(self.image_shape))):
                keep, add = _mattes_of(generator, block, latent, chunk)
                visible = torch.maximum(255 - keep.to(torch.int16) * 255 // WHOLE, add).amax((2, 3)) > VISIBLE
                counts.append(visible.sum(1))
                lines.append(visible.nonzero()[:, 1])
                mattes.append(torch.stack([keep[visible], add[visible]], 1))
        spans = torch.cat([*counts, torch.zeros(1, dtype=torch.int64)])  # the last cell, out of sight, is empty
        self._spans = torch.stack([spans.cumsum(0) - spans, spans], 1)
        self._lines, self._mattes = torch.cat(lines), torch.cat(mattes)

    def _views(self) -> tuple[Tensor, Tensor]:
        """Returns poses at the origin, with all settings of the flags, and the goal poses to see from there."""
        flags = self._poses.flags_of(torch.arange(self._poses.settings))
        origin = torch.cat([torch.zeros(len(flags), 3), flags], -1)
        relative = torch.cat([self._grid.relative_poses(offset) for offset in self._poses.goal_offset(origin)])
        flags, origin = (part.repeat_interleave(self._grid.cells, 0) for part in (flags, origin))
        return origin, torch.cat([relative, flags], -1)


def _mattes_of(
    generator: HallucinationGenerator, features: Tensor, latent: Tensor, chunk: int
) -> tuple[Tensor, Tensor]:
    """Returns the fraction of 128 that pixels keep, and the levels that are added to them, uint8 ``[N, H, W, C]``."""
    shape = generator.image_shape
    keep, add = torch.empty(2, len(features), *shape, dtype=torch.uint8)  # whole, or the heap falls to pieces
    for first in range(0, len(features), chunk):
        part = features[first : first + chunk]
        change = generator(part, latent.expand(len(part), -1))
        black, white = (generator.compose(image, change).permute(0, 2, 3, 1) for image in _grey(shape[2], -1.0, 1.0))
        keep[first : first + chunk] = ((white - black) * (WHOLE / 2)).round_()
        add[first : first + chunk] = ((black + 1) * (255 / 2)).round_()
    return keep, add


def _check_composition(generator: HallucinationGenerator) -> None:
    """Refuses what is no matte: one that maps a grey to something else than the mean of black and white."""
    height, width, channels = generator.image_shape
    images = torch.cat(_grey(channels, -1.0, 0.0, 1.0)).expand(-1, -1, height, width)
    with torch.no_grad():
        change = generator(torch.ones(1, generator.encoding.size), torch.ones(1, generator.latent_size))
        black, grey, white = generator.compose(images, change)
    if not torch.allclose(grey, (black + white) / 2, atol=1e-4):
        raise ValueError(
            f"{type(generator).__name__} does not lay a matte over images (a fraction of each pixel, and a colour), "
            "which is all that a bank can tabulate: use a CoordinateGenerator, or compute each image "
            "(GeneratorHallucinator, in the recipes --painter.no-bank)."
        )


def _grey(channels: int, *levels: float) -> list[Tensor]:
    """Returns one image of one pixel ``[1, C, 1, 1]`` for each level in [-1, 1]."""
    return [torch.full((1, channels, 1, 1), level) for level in levels]
