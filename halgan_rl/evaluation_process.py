"""Evaluation beside training, in a process of its own, or at once."""

import copy
import multiprocessing
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from halgan_rl.evaluation import Evaluation, evaluate


class EvaluationProcess:
    """Evaluates policies in a process of its own, so that training need not wait.

    A policy is copied when it is handed over, and its starts are fixed, so its figures are those of
    :func:`~halgan_rl.evaluation.evaluate`, whenever they come. Policies are taken one by one, in order. It is a
    context, with which the process ends; what it has not begun then is dropped.

    Args:
        make_env: makes the environment, in the other process: a function at the top of a module, or a
            ``functools.partial`` of one.
        threads: of PyTorch there.
        settings: further arguments of :func:`~halgan_rl.evaluation.evaluate`.

    Raises:
        RuntimeError: at the end of the context, if the process could not be started or has died.
    """

    def __init__(self, make_env: Callable[[], EnvBase], *, threads: int = 1, **settings: Any) -> None:
        self._settings = settings
        self._executor = ProcessPoolExecutor(
            1, mp_context=multiprocessing.get_context("spawn"), initializer=_open, initargs=(make_env, threads)
        )
        self._executor.submit(_is_open)  # Starting takes seconds: let them pass during the warm-up.

    def __call__(self, policy: TensorDictModuleBase) -> Future[Evaluation]:
        """Hand over a policy as it is now; its figures come later."""
        return self._executor.submit(_evaluate, copy.deepcopy(policy).cpu(), self._settings)

    def __enter__(self) -> "EvaluationProcess":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown(cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise RuntimeError(
                "the process that evaluates could not be started, or has died, for the reason printed above: start "
                "trainings from a file or a module, below `if __name__ == '__main__':`, or evaluate in this process "
                "(--no-background-evaluation)"
            ) from error


def evaluate_at_once(env: EnvBase, policy: TensorDictModuleBase, **settings: Any) -> Future[Evaluation]:
    """Evaluate a copy here and now; arguments as for :func:`~halgan_rl.evaluation.evaluate`."""
    done: Future[Evaluation] = Future()
    done.set_result(evaluate(env, copy.deepcopy(policy).cpu(), **settings))
    return done


_env: EnvBase


def _open(make_env: Callable[[], EnvBase], threads: int) -> None:
    global _env
    torch.set_num_threads(threads)
    _env = make_env()


def _is_open() -> None:
    """Done as soon as the process can evaluate."""


def _evaluate(policy: TensorDictModuleBase, settings: dict[str, Any]) -> Evaluation:
    return evaluate(_env, policy, **settings)
