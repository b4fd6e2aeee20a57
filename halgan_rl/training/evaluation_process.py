"""Evaluation beside training, in a process of its own, or at once."""

import copy
import multiprocessing
import pickle
import queue
import signal
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from halgan_rl.training.evaluation import Evaluation, evaluate
from halgan_rl.training.lifeline import Lifeline

REMEDY = "or evaluate in this process (evaluate_at_once; recipes: --evaluation.no-background)"


class ProcessEndedError(RuntimeError):
    """The process that evaluates has ended, or was ended; says what is known of why."""


class EvaluationProcess:
    """Evaluates policies in a process of its own, so that training need not wait.

    A policy is copied when it is handed over, and its starts are fixed, so its metrics are those of
    :func:`~halgan_rl.training.evaluation.evaluate`, whenever they come. Policies are taken one by one, in order.

    The process starts at once, which takes some seconds; entering the context waits for it. At the end of the context
    it finishes what it is at, or, if there was an error, is stopped. It ends with this process, however that ends.

    Args:
        make_env: makes the environment, in the other process; it must pickle: a function at the top of a module, or a
            ``functools.partial`` of one.
        threads: of PyTorch there.
        timeout: how long the start or one evaluation may take [s]; then the process is ended.
        settings: further arguments of :func:`~halgan_rl.training.evaluation.evaluate`.

    Raises:
        ProcessEndedError: on entering the context, or from an evaluation's ``result()``, if the process has died or
            takes longer than ``timeout``.
        RuntimeError: on entering the context, if the environment could not be made.
    """

    def __init__(
        self, make_env: Callable[[], EnvBase], *, threads: int = 1, timeout: float = 1_800.0, **settings: Any
    ) -> None:
        self._timeout = timeout
        self._tasks: queue.SimpleQueue[tuple[TensorDictModuleBase | None, Future] | None] = queue.SimpleQueue()
        self._lifeline = Lifeline()
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        arguments = (self._lifeline, theirs, make_env, threads, settings)
        self._process = context.Process(target=_serve, args=arguments, name="evaluation")
        self._process.start()
        theirs.close()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()
        self._started = self._hand_over(None)

    @property
    def pid(self) -> int | None:
        """Number of the other process."""
        return self._process.pid

    def __call__(self, policy: TensorDictModuleBase) -> Future[Evaluation]:
        """Hands over a policy as it is now; its metrics come later."""
        return self._hand_over(copy.deepcopy(policy).cpu())

    def __enter__(self) -> "EvaluationProcess":
        try:
            self._started.result()
        except BaseException as error:  # Ctrl-C, too, while the process starts
            self._end()
            if isinstance(error, ProcessEndedError) or not isinstance(error, Exception):
                raise
            raise RuntimeError(
                f"the environment could not be made in the process that evaluates: {error!r}; mend that, {REMEDY}"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._finish()
        finally:  # also if Ctrl-C interrupts the waiting
            self._end()

    def _hand_over(self, policy: TensorDictModuleBase | None) -> Future:
        future: Future = Future()
        self._tasks.put((policy, future))
        return future

    def _work(self) -> None:
        """Sends one policy after the other and waits for its metrics, in a thread."""
        while (task := self._tasks.get()) is not None:
            policy, future = task
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(self._ask(policy))
                except BaseException as error:
                    future.set_exception(error)

    def _ask(self, policy: TensorDictModuleBase | None) -> Evaluation | None:
        try:
            if policy is not None:  # None is for the start, which is answered unasked
                self._connection.send(policy)
            if not self._connection.poll(self._timeout):
                self._process.kill()
                raise ProcessEndedError(
                    f"the process that evaluates took longer than {self._timeout:g} s and was ended: give it a longer "
                    f"timeout, evaluate fewer starts, {REMEDY}"
                )
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise ProcessEndedError(f"the process that evaluates {self._fate()}, {REMEDY}") from error
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _fate(self) -> str:
        """Returns what is known of the end of the process, and what to do about it."""
        self._process.join(5.0)
        code = self._process.exitcode
        if code is None:
            return "has closed its pipe, yet runs: its environment must leave the descriptors of others alone"
        if code == -signal.SIGKILL:
            return "was killed (SIGKILL), by the system if it ran out of memory: free some"
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}: see what sent that, or what crashed in the environment"
        return (
            f"ended with exit code {code} before it answered: start trainings from a file or a module, below "
            "`if __name__ == '__main__':`, see whether the environment ends the process"
        )

    def _finish(self) -> None:
        """Waits for the evaluation that goes on, and drops those that have not begun."""
        while not self._tasks.empty():
            if (task := self._tasks.get()) is not None:
                task[1].cancel()
        self._tasks.put(None)
        self._thread.join(self._timeout)

    def _end(self) -> None:
        """Ends the process, at once."""
        self._lifeline.cut()
        self._tasks.put(None)
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()


def evaluate_at_once(env: EnvBase, policy: TensorDictModuleBase, **settings: Any) -> Future[Evaluation]:
    """Evaluates a copy here and now; arguments as for :func:`~halgan_rl.training.evaluation.evaluate`."""
    done: Future[Evaluation] = Future()
    done.set_result(evaluate(env, copy.deepcopy(policy).cpu(), **settings))
    return done


def _serve(
    lifeline: Lifeline,
    connection: Connection,
    make_env: Callable[[], EnvBase],
    threads: int,
    settings: dict[str, Any],
) -> None:
    """Evaluates policies for as long as any come: what the other process does."""
    lifeline.hold()
    torch.set_num_threads(threads)
    try:
        env = make_env()
    except Exception as error:
        connection.send(_portable(error))
        return
    connection.send(None)
    while True:
        try:
            answer: Evaluation | Exception = evaluate(env, connection.recv(), **settings)
        except EOFError:
            return
        except Exception as error:
            answer = _portable(error)
        connection.send(answer)


def _portable(error: Exception) -> Exception:
    """Returns an error with its traceback as a note, such that it can be sent."""
    trace = traceback.format_exc()
    error.add_note(f"in the process that evaluates:\n{trace}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"the evaluation failed:\n{trace}")
    return error
