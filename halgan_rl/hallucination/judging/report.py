"""All that is measured of a painter, as one report."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from halgan_rl.hallucination.judging.mask_overlaps import mask_overlaps
from halgan_rl.hallucination.judging.painting import paint_each, paint_one_goal
from halgan_rl.hallucination.judging.pose_probe import PoseProbe, probe_errors
from halgan_rl.hallucination.judging.scatter import cut_stretches, scatter
from halgan_rl.hallucination.training.data import Frames
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms.hallucinate_goal import Hallucinator

DISTANCES = (0.0, 0.3, 0.6, 1.0, 1.5, 6.0)
"""Bounds of the bands of distance [m]."""
BEARINGS = (0.0, 8.0, 16.0, 24.5)
"""Bounds of the bands of bearing, to either side [degrees]."""


@dataclass(frozen=True)
class View:
    """Where a whole goal is in view, and large enough for a probe to measure.

    Attributes:
        poses: where goals stand.
        widest: bearing, to either side [rad]; the default is for a camera that sees 0.43 to either side.
        farthest: distance [m].
    """

    poses: PlanarPoses
    widest: float = 0.36
    farthest: float = 1.5

    def polar(self, frames: Frames) -> Tensor:
        """Returns bearing [rad] and distance [m] of each row's goal, ``[N, 2]``."""
        return self.poses.goal_polar(frames["pose"], frames["goal_pose"])

    def holds(self, frames: Frames) -> Tensor:
        """Returns bool ``[N]``: whose goal is wholly in view and near."""
        bearing, distance = self.polar(frames).unbind(-1)
        return (bearing.abs() < self.widest) & (distance < self.farthest)

    def select(self, frames: Frames) -> Frames:
        """Returns the rows whose goal is wholly in view and near."""
        rows = self.holds(frames)
        return {name: entry[rows] for name, entry in frames.items()}


def judge(
    painter: Hallucinator,
    truth: Hallucinator,
    *,
    probe: PoseProbe,
    view: View,
    near_goal: Frames,
    rollouts: Frames,
    walks: Frames,
) -> dict[str, Any]:
    """Compares a painter with the truth.

    Args:
        painter: is judged.
        truth: paints goals as the simulator shows them.

    Keyword Args:
        probe: has seen real frames only.
        view: what the probe can measure.
        near_goal: real frames: ``pixels`` uint8 ``[N, H, W, C]``, ``pose`` and ``goal_pose`` ``[N, P]``, and ``empty``,
            the same images without a goal.
        rollouts: likewise, consecutive frames.
        walks: ``pixels`` without goals, ``pose`` and ``goal_pose`` of random walks.

    Returns:
        ``probe`` (:func:`~.pose_probe.probe_errors`); ``mask``, ``mask_by_distance``, ``mask_by_bearing`` and ``no_op``
        (:func:`~.mask_overlaps.mask_overlaps`); ``consistency``, how far goals scatter [m] in real frames, in truth and
        as painted (:func:`~.scatter.scatter`).
    """
    painters = {"truth": truth, "hallucinated": painter}
    empty = near_goal | {"pixels": near_goal["empty"]}
    images = {"real": near_goal["pixels"]} | {label: paint_each(by, empty) for label, by in painters.items()}
    report: dict[str, Any] = {"probe": probe_errors(probe, view.polar(near_goal), images)}

    true, painted = (paint_each(by, walks) for by in painters.values())
    report |= mask_overlaps(walks["pixels"], true, painted, view.polar(walks), distances=DISTANCES, bearings=BEARINGS)

    stretches = cut_stretches(rollouts, view.holds(rollouts))
    empty_ones = [stretch | {"pixels": stretch["empty"]} for stretch in stretches]
    seen = {"real": [(stretch["pose"], stretch["pixels"]) for stretch in stretches]}
    for label, by in painters.items():
        seen[label] = [(stretch["pose"], paint_one_goal(by, stretch)) for stretch in empty_ones]
    return report | {"consistency": {label: scatter(probe, pairs) for label, pairs in seen.items()}}


def as_text(report: dict[str, Any]) -> str:
    """Returns a report as a table for people."""
    probe, no_op = report["probe"], report["no_op"]
    lines = [f"{'pose probe':24s} {'bearing':>10s} {'distance':>10s}   ({probe['frames']} frames)"]
    for label in ("real", "truth", "hallucinated"):
        lines.append(f"  {label:22s} {probe[label]['bearing_degrees']:8.2f} ° {probe[label]['distance_metres']:8.3f} m")
    lines.append(f"  {'hallucinated / real':22s} {probe['ratio']['bearing']:8.2f}   {probe['ratio']['distance']:8.2f}")
    lines.append("mask overlap")
    for label, band in {**report["mask"], **report["mask_by_distance"], **report["mask_by_bearing"]}.items():
        lines.append(f"  {label:22s} {band['overlap']:8.2f}   ({band['frames']} frames)")
    lines.append(f"change outside the mask  {no_op['outside_the_mask']:8.2f} / 255")
    lines.append(f"change out of view       {no_op['out_of_view']:8.2f} / 255   ({no_op['frames_out_of_view']} frames)")
    scattered = (f"{value:.3f} m ({label})" for label, value in report["consistency"].items())
    return "\n".join([*lines, f"goal scatters in the room by {', '.join(scattered)}"])
