"""What generators are trained on: near-goal frames and failed ones, matched by the goal that is pursued in them."""

from torch import Tensor

from halgan_rl.poses import flag_number

Frames = dict[str, Tensor]
"""``pixels`` uint8 [N, 64, 64, 3], ``pose`` [N, P]; near-goal frames also ``goal_pose`` [N, P]."""


def matching_flags(near_goal: Frames, failed: Frames) -> tuple[Tensor, Tensor]:
    """Number the flags of near-goal poses and of failed ones, int64 ``[N]`` and ``[M]``: they tell the goals apart.

    Raises:
        ValueError: if there is a near-goal frame with flags that no failed frame has.
    """
    near, other = flag_number(near_goal["pose"]), flag_number(failed["pose"])
    lacking = set(near.tolist()) - set(other.tolist())
    if lacking:
        example = near_goal["pose"][near == min(lacking)][0, 3:].tolist()
        raise ValueError(
            f"there are near-goal frames with the flags {example}, but no failed ones to paint that goal into: "
            "collect failed frames with these flags as well"
        )
    return near, other
