"""Values that change linearly while a run goes on."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Annealing:
    """A value that goes linearly from ``start`` to ``end`` over ``frames`` environment frames, and stays there.

    Raises:
        ValueError: if ``frames`` is less than 1.

    Examples:
        >>> Annealing(1.0, 0.5, 100).at(50)
        0.75
    """

    start: float
    """Value at first."""
    end: float
    """Value at the end."""
    frames: int
    """Environment frames from the one to the other."""

    def __post_init__(self) -> None:
        """Refuses a span that is no span."""
        if self.frames < 1:
            raise ValueError(f"frames must be at least 1 environment frame, got {self.frames}.")

    def at(self, frames: int) -> float:
        """Returns the value after so many frames."""
        done = min(frames / self.frames, 1.0)
        return self.start + done * (self.end - self.start)
