import dataclasses
import json

import pytest
import torch

pytest.importorskip("stable_baselines3", reason="the peers live in an environment of their own: make bench")

from benchmarks import replay, sb3_peers, update_cost, updates
from benchmarks.rounds import ratio, take_turns
from benchmarks.rows import EPISODE, Rows, channels_first, plain
from benchmarks.tables import Table, report
from halgan_rl.agents.fast_cpu import block_encoder
from halgan_rl.agents.fast_cpu.block_convolutions import halve
from halgan_rl.experiment.presets import changed
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.transforms import pipelines

TINY = replay.Benchmark(rounds=1, calls=1)


def test_frames_are_shared_by_neighbours_and_by_no_other_rows():
    rows = Rows(8).take(2 * EPISODE)
    storage = FrameStorage(len(rows))
    storage.set(range(len(rows)), plain(rows))
    assert storage.frames_kept == 2 * (EPISODE + 1)


def test_filling_a_peers_arrays_does_what_adding_does():
    rows, filled, added = Rows(8).take(2 * EPISODE), *(sb3_peers.make_her_buffer(2 * EPISODE, 8) for _ in range(2))
    sb3_peers.fill(filled, rows)
    sb3_peers.add(added, sb3_peers.transitions(rows, goals=True))
    for name in ("ep_start", "ep_length", "actions", "rewards", "dones", "timeouts"):
        assert (getattr(filled, name) == getattr(added, name)).all(), name
    for name, values in filled.next_observations.items():
        assert (values == added.next_observations[name]).all(), name
    assert (filled.next_observations["observation"][:, 0] == channels_first(rows["next", "pixels"]).numpy()).all()
    assert (filled.pos, filled.full) == (added.pos, added.full)


def test_replay_compares_every_buffer_at_every_size():
    lines = replay.compare(8, (2 * EPISODE, 3 * EPISODE), TINY)
    assert len(lines) == 2 * (2 + 5)
    assert {len(line) for line in lines} == {len(replay.HEADER)}


@pytest.mark.parametrize("algorithm", updates.ALGORITHMS.values(), ids=updates.ALGORITHMS)
def test_updates_run_on_networks_of_the_same_size(algorithm):
    for run in updates.make_updates(algorithm, Rows(64).take(EPISODE)).values():
        run(1)


@pytest.mark.parametrize("algorithm", updates.ALGORITHMS.values(), ids=updates.ALGORITHMS)
def test_different_networks_are_refused(algorithm):
    other = {"ours": lambda config, rows, batch_size: (lambda: None, (1, 2))}
    changed = dataclasses.replace(algorithm, variants={**algorithm.variants, **other})
    with pytest.raises(RuntimeError, match="the networks differ"):
        updates.make_updates(changed, Rows(64).take(EPISODE))


@pytest.mark.parametrize(("double", "passes"), [(True, 3), (False, 2)])
def test_a_double_update_runs_a_network_once_more(double, passes, monkeypatch):
    rows = Rows(64).take(EPISODE)
    rows["action"] = updates.CHOICE.rand((EPISODE,))
    run, _ = updates.ours(updates.CHOICE, updates.ALGORITHMS["DDQN"].config, rows, 32, double=double)
    passed = []

    def spy(images, networks, *how):
        passed.extend(networks)
        return halve(images, networks, *how)

    monkeypatch.setattr(block_encoder, "halve", spy)
    run(1)
    assert len(passed) == passes


def test_a_peers_target_made_double_values_what_the_network_chooses():
    chooses, values = torch.tensor([[0.0, 2.0, 1.0], [5.0, 2.0, 1.0]]), torch.tensor([[3.0, 4.0, 9.0], [6.0, 7.0, 8.0]])
    target = sb3_peers.DoubleTarget(lambda _: chooses, lambda _: values)
    assert target(torch.zeros(2, 3, 64, 64)).max(1).values.tolist() == [4.0, 6.0]


@pytest.mark.parametrize(("double", "asked"), [(True, 2), (False, 1)])
def test_a_peers_target_network_follows_and_is_double_if_asked(double, asked, monkeypatch):
    config = updates.ALGORITHMS["DDQN"].config
    rows = Rows(64).take(EPISODE)
    rows["action"] = updates.CHOICE.rand((EPISODE,))
    followed, seen = [], []
    monkeypatch.setattr(sb3_peers, "polyak_update", lambda *pairs: followed.append([list(each) for each in pairs[:2]]))
    forward = sb3_peers.Features.forward

    def spy(self, observations):
        seen.append(torch.is_grad_enabled())
        return forward(self, observations)

    monkeypatch.setattr(sb3_peers.Features, "forward", spy)
    run, (parameters,) = sb3_peers.make_dqn_updates(rows, config, 1e-3, 4, double=double)
    run(1)
    assert sorted(seen) == [False] * asked + [True]  # at s', and at s
    ((sources, targets),) = followed
    assert sum(target.numel() for target in targets) == parameters
    assert not {id(source) for source in sources} & {id(target) for target in targets}


def test_the_cost_of_hindsight_is_measured_on_the_recipes_update():
    config = changed(update_cost.DEFAULT, {"training.batch_size": 4})
    update_cost.make_updates(config, Rows(64).take(EPISODE), pipelines.none(), 2)()


def test_rounds_alternate_and_the_first_does_not_count():
    order = []
    values = {"a": iter([9.0, 1.0, 2.0, 6.0]), "b": iter([0.0, 3.0, 4.0, 5.0])}
    measures = {name: lambda name=name: order.append(name) or next(values[name]) for name in values}
    assert take_turns(measures, rounds=3) == {"a": [1.0, 2.0, 6.0], "b": [3.0, 4.0, 5.0]}
    assert order == ["a", "b"] * 4


def test_a_ratio_is_the_median_of_the_rounds_not_the_ratio_of_medians():
    assert ratio([1.0, 20.0, 3.0], [2.0, 10.0, 1.0]) == 2.0
    with pytest.raises(ValueError, match="shorter"):
        ratio([1.0, 2.0], [1.0])


def test_a_saved_table_names_versions_but_no_machine(tmp_path, capsys):
    report("speed", [Table("Speed.", ("what", "steps/s"), [["ours", "7"]])], tmp_path)
    saved = json.loads((tmp_path / "speed.json").read_text())
    assert saved["tables"][0]["rows"] == [["ours", "7"]]
    assert saved["machine"].keys() == {"cpus", "python", "torch", "torchrl"}
    assert saved["machine"]["torch"].split("+")[0] == torch.__version__.split("+")[0]
    assert "| ours | 7 |" in capsys.readouterr().out
