"""What a training reports: means between evaluations, and a row of metrics for each evaluation."""

import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future

import torch
from torch import Tensor
from torchrl.record.loggers import Logger

from halgan_rl.experiment.run_folder import RunFolder
from halgan_rl.training.evaluation import Evaluation


class Means:
    """Means of figures between two evaluations, without a synchronisation an update.

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
        """Add a value, or the mean of several, to each named mean."""
        for name, value in values.items():
            self._values.setdefault(name, []).append(value.detach().float().mean())

    def pop(self) -> dict[str, float]:
        """Return all means and start afresh."""
        means = {name: float(torch.stack(values).mean()) for name, values in self._values.items()}
        self._values = {}
        return means


class Report:
    """Rows of metrics, each written when its evaluation is done; training need not wait for it.

    Args:
        folder: gets the rows, in order. Columns of which a row has nothing are NaN there; ``seconds`` counts from
            here until the row is written, with its evaluation.
        logger: gets them as well.

    Attributes:
        success: success rate of the last row written; NaN before the first.
    """

    def __init__(self, folder: RunFolder, logger: Logger | None = None) -> None:
        self.success = float("nan")
        self._folder = folder
        self._logger = logger
        self._started = time.perf_counter()
        self._waiting: deque[tuple[Mapping[str, float], Future[Evaluation]]] = deque()

    def add(self, metrics: Mapping[str, float], evaluation: Future[Evaluation]) -> None:
        """Take a row without its evaluation, which may still be going on; ``frames`` must be among the metrics."""
        self._waiting.append((metrics, evaluation))

    def write(self, *, wait: bool = False) -> None:
        """Write the rows whose evaluations are done, or, on ``wait``, all rows.

        Raises:
            Exception: whatever an evaluation raised.
        """
        while self._waiting and (wait or self._waiting[0][1].done()):
            metrics, evaluation = self._waiting.popleft()
            self._write(dict.fromkeys(self._folder.columns, float("nan")) | dict(metrics), evaluation.result())

    def _write(self, row: dict[str, float], evaluation: Evaluation) -> None:
        self.success = evaluation.success_rate
        row |= {"seconds": time.perf_counter() - self._started} | evaluation.metrics()
        self._folder.write_metrics(row)
        if self._logger is not None:
            for name, value in row.items():
                self._logger.log_scalar(name, value, step=int(row["frames"]))
