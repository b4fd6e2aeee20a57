import time

import pytest

from benchmarks import frame_time
from benchmarks.frame_time import PARTS, Benchmark, Stopwatch, a_frame, describe, make_round
from halgan_rl.experiment.presets import changed

TINY = Benchmark(rounds=1, frames=32, rows=112, starts=1)


def test_a_part_is_timed_without_the_parts_within_it():
    now = [0.0]
    watch = Stopwatch("loop", clock=lambda: now[0])

    def spend(seconds):
        now[0] += seconds

    inner = watch.timed("inner", lambda: spend(5.0))

    def outer():
        spend(1.0)
        inner()
        spend(2.0)

    spend(10.0)
    watch.timed("outer", outer)()
    spend(20.0)
    watch.switch("loop")
    assert watch.seconds == {"loop": 30.0, "outer": 3.0, "inner": 5.0}
    watch.restart()
    assert watch.seconds == {}


def test_a_part_that_fails_ends():
    watch = Stopwatch("loop")
    with pytest.raises(ZeroDivisionError):
        watch.timed("division", lambda: 1 / 0)()
    assert watch.switch("loop") == "loop"


@pytest.mark.parametrize("recipe", frame_time.RECIPES.values(), ids=frame_time.RECIPES)
def test_the_parts_of_a_training_are_all_that_it_takes(recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(frame_time, "a_frame", lambda seconds, *_: dict(seconds))
    go_on = make_round(recipe, TINY, tmp_path / "run", {"painter.bank": False})
    go_on()
    started = time.process_time()
    seconds = go_on()
    assert sum(seconds.values()) == pytest.approx(time.process_time() - started, rel=0.01)
    assert set(seconds) == set(PARTS)
    assert min(seconds.values()) > 0


def test_evaluation_is_spread_over_the_frames_between_two():
    config = changed(frame_time.ddpg_navigate.DEFAULT, {"evaluation.every": 1_000, "evaluation.starts": 50})
    benchmark = Benchmark(frames=100, starts=5, episode_share=0.5)
    times = a_frame(dict.fromkeys(PARTS, 8.0), config, benchmark)
    assert times[frame_time.UPDATE] == 8.0 / 100
    assert times[frame_time.EVALUATION] == 8.0 * 10 * 0.5 / 1_000


def test_the_shares_of_a_frame_are_those_of_all_its_parts():
    seconds = {part: 1e-3 * (1 + place) for place, part in enumerate(PARTS)}
    lines = {line[0]: line[1:] for line in describe({"a": seconds, "b": dict.fromkeys(PARTS, 2e-3)})}
    assert lines[frame_time.RENDERING] == ["2.00", "4.4%", "2.00", "11.1%"]
    assert lines["together: collecting"] == ["6.00", "13.3%", "6.00", "33.3%"]
    assert lines["together: a frame"] == ["45.00", "100.0%", "18.00", "100.0%"]
