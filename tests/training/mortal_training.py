"""A training with both kinds of child processes, which says what it is at, to be ended at that moment.

Run by ``python -m tests.training.mortal_training MOMENT``.
"""

import signal
import sys
import time

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from halgan_rl.training.background_collector import BackgroundCollector
from halgan_rl.training.evaluation_process import EvaluationProcess
from tests.toy import Parking


class Forward(nn.Module):
    """Drives ahead, at leisure."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, pose: Tensor) -> Tensor:
        time.sleep(0.01)
        return (self.weight * pose[..., 0]).squeeze().long()


def say(moment: str) -> None:
    sys.stdout.write(f"{moment}\n")
    sys.stdout.flush()


def reach(moment: str) -> None:
    """Says that the moment has come, and stays at it."""
    if sys.argv[1] == moment:
        say(moment)
        if moment not in ("starting", "shutting down"):
            while True:
                torch.ones(200, 200) @ torch.ones(200, 200)


def main() -> None:
    policy = TensorDictModule(Forward(), in_keys=["pose"], out_keys=["action"])
    evaluate = EvaluationProcess(Parking, seeds=[1])
    reach("starting")
    collector = BackgroundCollector(Parking, policy, frames_per_batch=32, total_frames=-1)
    if sys.argv[1] == "without cleaning up":
        next(iter(collector))
        reach("without cleaning up")
    with evaluate:
        try:
            for number, _ in enumerate(collector):
                evaluate(policy)
                reach("updating")
                if number == 1 and sys.argv[1] == "shutting down":
                    break
                if sys.argv[1] == "collecting":
                    say("collecting")
        finally:
            reach("shutting down")
            collector.shutdown()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs start with it ignored
    main()
