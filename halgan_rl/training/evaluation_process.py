"""Evaluation beside training, in a process of its own, or at once."""

import copy
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from types import TracebackType
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from halgan_rl.training.evaluation import Evaluation, evaluate


class EvaluationProcess:
    """Evaluates policies in a process of its own, so that training need not wait.

    A policy is copied when it is handed over, and its starts are fixed, so its figures are those of
    :func:`~halgan_rl.training.evaluation.evaluate`, whenever they come. Policies are taken one by one, in order.

    The process starts at once, which takes some seconds; entering the context waits for it. At the end of the context
    it finishes what it is at, or, if there was an error, is stopped.

    Args:
        make_env: makes the environment, in the other process; it must pickle: a function at the top of a module, or a
            ``functools.partial`` of one.
        threads: of PyTorch there.
        settings: further arguments of :func:`~halgan_rl.training.evaluation.evaluate`.

    Raises:
        RuntimeError: on entering the context, if the process could not be started; on leaving it, if it has died.
    """

    def __init__(self, make_env: Callable[[], EnvBase], *, threads: int = 1, **settings: Any) -> None:
        self._settings = settings
        self._executor = ProcessPoolExecutor(
            1, mp_context=multiprocessing.get_context("spawn"), initializer=_open, initargs=(make_env, threads)
        )
        self._started = self._executor.submit(os.getpid)

    def __call__(self, policy: TensorDictModuleBase) -> Future[Evaluation]:
        """Hand over a policy as it is now; its figures come later."""
        return self._executor.submit(_evaluate, copy.deepcopy(policy).cpu(), self._settings)

    def __enter__(self) -> "EvaluationProcess":
        try:
            self._started.result()
        except BrokenProcessPool as error:
            self._executor.shutdown()
            raise _died() from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None and not isinstance(error, BrokenProcessPool):
            os.kill(self._started.result(), signal.SIGTERM)
        self._executor.shutdown(cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise _died() from error


def _died() -> RuntimeError:
    return RuntimeError(
        "the process that evaluates could not be started, or has died, for the reason printed above: start trainings "
        "from a file or a module, below `if __name__ == '__main__':`, or evaluate in this process "
        "(--no-background-evaluation)"
    )


def evaluate_at_once(env: EnvBase, policy: TensorDictModuleBase, **settings: Any) -> Future[Evaluation]:
    """Evaluate a copy here and now; arguments as for :func:`~halgan_rl.training.evaluation.evaluate`."""
    done: Future[Evaluation] = Future()
    done.set_result(evaluate(env, copy.deepcopy(policy).cpu(), **settings))
    return done


_env: EnvBase


def _open(make_env: Callable[[], EnvBase], threads: int) -> None:
    global _env
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    _env = make_env()


def _end_with_parent() -> None:
    """End this process when the one that trains is gone, however it went."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _evaluate(policy: TensorDictModuleBase, settings: dict[str, Any]) -> Evaluation:
    return evaluate(_env, policy, **settings)
