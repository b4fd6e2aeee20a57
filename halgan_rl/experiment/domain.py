"""What a run must know of an environment: the form that a user fills in to bring their own."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from halgan_rl.keys import Keys, dotted
from halgan_rl.poses import PlanarPoses
from halgan_rl.transforms import Hallucinator


@dataclass(frozen=True)
class Domain:
    """An environment, and all that a run must know of it. Frozen, built once, handed to whoever needs it.

    The package ``halgan_envs`` fills one in for each of its environments (``halgan_envs.domain("navigate-2m")``).

    Raises:
        ValueError: if the image shape is no height, width, channels.
    """

    name: str
    """Names the environment in folders, pictures and manifests."""
    make: Callable[..., EnvBase]
    """``make(seed=...)`` makes the environment; it must pickle: a function of a module, or a partial of one."""
    action_spec: TensorSpec
    """Actions of the environment: ``Bounded`` ``[A]``, or ``OneHot`` ``[A]``."""
    image_shape: tuple[int, int, int] = (64, 64, 3)
    """Height, width and channels of the environment's uint8 images."""
    frame_stack: int = 1
    """How many frames are stacked along the channels of an image, each with the same number of channels."""
    poses: PlanarPoses = field(default_factory=PlanarPoses)
    """What the entries of a pose mean, where goals stand, and when one is reached in hindsight."""
    keys: Keys = field(default_factory=Keys)
    """Where the environment writes what."""
    fingerprint: Mapping[str, str] = field(default_factory=dict)
    """What the images depend on, such as versions and the hash of a golden frame: stamped into weights."""
    goal_renderer: Callable[[], Hallucinator] | None = None
    """Returns an oracle that paints the goal as the simulator shows it; None if there is none."""
    overview: Callable[[EnvBase, int, int], np.ndarray] | None = None
    """``overview(env, height, width)`` returns a picture for people, uint8 ``[height, width, 3]``; or None."""

    def __post_init__(self) -> None:
        """Refuses what is no image shape."""
        if len(self.image_shape) != 3 or min(self.image_shape) < 1 or self.image_shape[2] % self.frame_stack:
            raise ValueError(
                f"image_shape={self.image_shape} must be height, width and channels, the channels a multiple of "
                f"frame_stack={self.frame_stack}."
            )

    def check(self, env: EnvBase) -> None:
        """Raises a ``ValueError`` unless an environment observes and acts as the domain says; names what differs."""
        promised = {
            "pixels": (self.keys.pixels, self.image_shape),
            "pose": (self.keys.pose, (self.poses.size,)),
            "action": (self.keys.action, tuple(self.action_spec.shape)),
        }
        specs = {**dict(env.observation_spec.items(True, True)), **dict(env.full_action_spec.items(True, True))}
        for name, (key, shape) in promised.items():
            if key not in specs:
                found = ", ".join(sorted(map(dotted, specs)))
                raise ValueError(
                    f"the environment of the domain {self.name!r} has no {dotted(key)}, set by keys=Keys({name}="
                    f"{getattr(self.keys, name)!r}); it has {found}."
                )
            if tuple(specs[key].shape) != shape:
                raise ValueError(
                    f"{dotted(key)} of the environment is {tuple(specs[key].shape)}, the domain {self.name!r} says "
                    f"{shape}: correct the domain. Images are height, width, channels."
                )
        if specs[self.keys.pixels].dtype != torch.uint8:
            raise ValueError(
                f"{dotted(self.keys.pixels)} of the environment is {specs[self.keys.pixels].dtype}, but images must be "
                "uint8, as they are rendered."
            )
