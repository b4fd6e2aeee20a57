"""The rows that a transform holds back, and the way back to those before its last write."""

from torch import Tensor

from halgan_rl.transforms.unfinished_episode import UnfinishedEpisode


class HeldRows:
    """Rows held back, one :class:`UnfinishedEpisode` an environment; none before the first write.

    Attributes:
        waiting: the rows held back now.
    """

    def __init__(self) -> None:
        self.waiting: list[UnfinishedEpisode] = []
        self._before: list[UnfinishedEpisode] | None = None
        self._flushed: Tensor | None = None

    def copy(self, environments: int) -> list[UnfinishedEpisode]:
        """Returns the rows held back, to be changed and then given to :meth:`write`; empty ones before the first."""
        return [each.copy() for each in self.waiting] or [UnfinishedEpisode() for _ in range(environments)]

    def write(self, waiting: list[UnfinishedEpisode], flushed: Tensor | None = None) -> None:
        """Replaces the rows held back.

        Args:
            waiting: those to hold back from now on.
            flushed: a tensor of the rows that were released for somebody to write them later.
        """
        self._before, self.waiting, self._flushed = self.waiting, waiting, flushed

    def passed(self, marker: Tensor | None) -> None:
        """Says that rows passed by which were not held back, ``marker`` among them, or that none did.

        Those that :meth:`write` released last may still be taken back, if it is them.
        """
        if marker is None or marker is not self._flushed:
            self._before = self._flushed = None

    def undo(self) -> None:
        """Takes the last write back, if it was not taken back yet and nothing passed by since."""
        if self._before is not None:
            self.waiting, self._before, self._flushed = self._before, None, None

    def drop(self, waiting: list[UnfinishedEpisode] | None = None) -> None:
        """Forgets all rows, or replaces them for good by others."""
        self.waiting, self._before, self._flushed = waiting or [], None, None
