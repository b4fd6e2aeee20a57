"""Metrics of a training: means between evaluations, and a row for each evaluation."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future

import torch
from torch import Tensor
from torchrl.record.loggers import Logger

from halgan_rl.training.evaluation import Evaluation


class Means:
    """Means of values between two evaluations, without a synchronisation an update.

    Examples:
        >>> means = Means()
        >>> means.add(loss=torch.tensor([1.0, 3.0]))
        >>> means.add(loss=torch.tensor(4.0))
        >>> means.pop(), means.pop()
        ({'loss': 3.0}, {})
    """

    def __init__(self) -> None:
        self._values: dict[str, list[Tensor]] = {}

    def add(self, **values: Tensor) -> None:
        """Adds a value, or the mean of several, to each named mean."""
        for name, value in values.items():
            self._values.setdefault(name, []).append(value.detach().float().mean())

    def pop(self) -> dict[str, float]:
        """Returns all means and starts afresh."""
        means = {name: float(torch.stack(values).mean()) for name, values in self._values.items()}
        self._values = {}
        return means


class Report:
    """Rows of metrics, each written when its evaluation is done; training need not wait for it.

    Args:
        columns: of a row. What a row lacks is NaN there; ``seconds`` counts from here until the row is written.
        write: keeps a row; called in order.
        logger: gets the rows as well.

    Attributes:
        success: success rate of the last row written; NaN before the first.
    """

    def __init__(
        self, columns: Sequence[str], write: Callable[[dict[str, float]], None], logger: Logger | None = None
    ) -> None:
        self.success = float("nan")
        self._columns = columns
        self._write_row = write
        self._logger = logger
        self._started = time.perf_counter()
        self._waiting: deque[tuple[Mapping[str, float], Future[Evaluation]]] = deque()

    @property
    def shown_success(self) -> str:
        """The success rate for people; a dash before the first evaluation is done."""
        return "-" if math.isnan(self.success) else f"{self.success:.0%}"

    def add(self, metrics: Mapping[str, float], evaluation: Future[Evaluation]) -> None:
        """Takes a row without its evaluation, which may still be going on; ``frames`` must be among the metrics."""
        self._waiting.append((metrics, evaluation))

    def write(self, *, wait: bool = False) -> None:
        """Writes the rows whose evaluations are done, or, on ``wait``, all rows.

        Raises:
            Exception: whatever an evaluation raised.
        """
        while self._waiting and (wait or self._waiting[0][1].done()):
            metrics, evaluation = self._waiting.popleft()
            self._write(dict.fromkeys(self._columns, float("nan")) | dict(metrics), evaluation.result())

    def _write(self, row: dict[str, float], evaluation: Evaluation) -> None:
        self.success = evaluation.success_rate
        row |= {"seconds": time.perf_counter() - self._started} | evaluation.metrics()
        self._write_row(row)
        if self._logger is not None:
            for name, value in row.items():
                self._logger.log_scalar(name, value, step=int(row["frames"]))
