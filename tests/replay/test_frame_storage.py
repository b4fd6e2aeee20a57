import copy
import json
import logging
import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictMaxValueWriter,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers import RandomSampler, SamplerWithoutReplacement, SliceSampler

from halgan_rl.keys import Keys
from halgan_rl.replay import frame_checkpointer, frame_storage, free_room
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.replay.frame_table import OVERHEAD
from halgan_rl.transforms import StampFuturePoses
from tests.replay.parking import collect, relabelling
from tests.transforms.rows import assert_identical, random_source

SHAPE = (2, 5, 3)
ENTRIES = 4 * 3 + 4 * 2 + 4 * 3 + 4 + 1
"""Bytes of a row's entries other than frames."""


def frame(number: int) -> Tensor:
    """A frame (not square) with its number in two places."""
    pixels = torch.full(SHAPE, 3, dtype=torch.uint8)
    pixels[0, 4, 1], pixels[1, 2, 0] = number % 256, number // 256
    return pixels


def row(number: int, before: int, after: int, done: bool = False) -> TensorDict:
    """A row with its number in every entry, root unlike next, between two frames."""
    ramp = torch.tensor([1.0, 2.0, 3.0])
    return TensorDict(
        {
            "pixels": frame(before),
            "pose": number + ramp,
            "action": number - ramp[:2],
            "next": {
                "pixels": frame(after),
                "pose": -number - ramp,
                "reward": torch.tensor([0.5 + number]),
                "done": torch.tensor([done]),
            },
        }
    )


def episode(length: int, first: int = 0) -> TensorDict:
    """Consecutive rows ``[length]`` with frames first ... first + length."""
    return torch.stack([row(first + t, first + t, first + t + 1, t == length - 1) for t in range(length)])


def buffer_on(storage: object, **options: object) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=storage, generator=random_source(5), **{"batch_size": 16, **options})


def shown(rows: list[TensorDict]) -> set[bytes]:
    return {part["pixels"].numpy().tobytes() for each in rows for part in (each, each["next"])}


@st.composite
def streams(draw: st.DrawFn) -> list[list[TensorDict]]:
    """Batches as several environments write them: consecutive rows of one, then of another, and episodes that end.

    Frames are numbered on, or drawn from a few that return.
    """
    environments, numbers = draw(st.integers(1, 3)), iter(range(10_000))
    returning = draw(st.booleans())

    def new_frame() -> int:
        return draw(st.integers(0, 3)) if returning else next(numbers)

    now, batches, count = [new_frame() for _ in range(environments)], [], 0
    for _ in range(draw(st.integers(1, 8))):
        batch = []
        for _ in range(draw(st.integers(1, 4))):
            environment = draw(st.integers(0, environments - 1))
            for _ in range(draw(st.integers(1, 4))):
                after, done = new_frame(), draw(st.integers(0, 3)) == 0
                batch.append(row(count, now[environment], after, done))
                now[environment] = new_frame() if done else after
                count += 1
        batches.append(batch)
    return batches


@settings(deadline=None, max_examples=60)
@given(streams(), st.integers(1, 12), st.sampled_from(["extend", "add"]), st.booleans())
def test_any_interleaving_of_environments_episodes_and_wraps_gives_the_rows_of_a_plain_list(
    batches: list[list[TensorDict]], max_size: int, method: str, mapped: bool
) -> None:
    folder = Path(tempfile.gettempdir()) if mapped else None
    storage = FrameStorage(max_size, extra_frames=max_size, scratch_dir=folder)
    buffer = ReplayBuffer(storage=storage)
    kept: list[TensorDict] = []
    written = 0
    for batch in batches:
        if method == "extend":
            buffer.extend(torch.stack(batch))
        else:
            for each in batch:
                buffer.add(each.clone())
        for each in batch:
            kept[written % max_size : written % max_size + 1] = [each]
            written += 1
        assert len(storage) == len(kept)
        assert_identical(storage[:], torch.stack(kept))
        assert_identical(storage[torch.arange(len(kept))], torch.stack(kept))
        assert storage.frames_kept == len(shown(kept))


@settings(deadline=None, max_examples=60)
@given(streams(), st.integers(1, 12), st.integers(0, 6))
def test_frames_are_refused_only_if_there_is_no_room_and_then_nothing_is_written(
    batches: list[list[TensorDict]], max_size: int, extra_frames: int
) -> None:
    storage = FrameStorage(max_size, extra_frames=extra_frames)
    kept: dict[int, TensorDict] = {}
    written = 0
    for batch in batches:
        places = [(written + i) % max_size for i in range(len(batch))]
        after = {**kept, **dict(zip(places, batch, strict=True))}
        if len(shown(list(after.values()))) > max_size + extra_frames:
            with pytest.raises(RuntimeError, match="none of which was written"):
                storage.set(places, torch.stack(batch))
        else:
            storage.set(places, torch.stack(batch))
            kept, written = after, written + len(batch)
        assert len(storage) == len(kept)
        if kept:
            assert_identical(storage[:], torch.stack([kept[place] for place in sorted(kept)]))


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 9), st.integers(0, 9)), min_size=1), max_size=8),
)
def test_writing_at_any_places_in_any_order_gives_the_rows_of_a_plain_list(batches: list) -> None:
    storage = FrameStorage(7, extra_frames=7)
    storage.set(slice(0, 7), episode(7, first=100))
    kept = list(episode(7, first=100).unbind(0))
    for number, batch in enumerate(batches):
        rows = [row(10 * number, before, after) for _, before, after in batch]
        storage[[place for place, *_ in batch]] = torch.stack(rows)
        for (place, *_), each in zip(batch, rows, strict=True):
            kept[place] = each
        assert_identical(storage[:], torch.stack(kept))
        assert storage.frames_kept == len(shown(kept))


@pytest.mark.parametrize(
    "index",
    [
        3,
        -1,
        slice(1, 6, 2),
        slice(None),
        range(2, 5),
        [4, 0, 4],
        torch.tensor([5, 5, 1]),
        torch.tensor([], dtype=torch.int64),
        torch.tensor([[0, 1], [2, 3]]),
        torch.tensor(2),
        torch.arange(7) % 2 == 0,
        torch.tensor([6, 2]).numpy(),
    ],
    ids=str,
)
@pytest.mark.parametrize("mapped", [False, True])
def test_rows_are_read_by_any_index_as_from_torchrls_storage_but_copied(
    index: object, mapped: bool, tmp_path: Path
) -> None:
    reference, storage = LazyTensorStorage(9), FrameStorage(9, scratch_dir=tmp_path if mapped else None)
    for each in (reference, storage):
        each.set(range(7), episode(7))
    rows = storage[index]
    assert rows.batch_size == reference[index].batch_size
    assert rows.device == reference[index].device
    assert_identical(rows, reference[index])
    rows.apply_(lambda value: value.fill_(1))
    rows["pose"] = torch.zeros(*rows.batch_size, 3)
    assert_identical(storage[:], episode(7))


@pytest.mark.parametrize(
    "cursor", [range(2, 5), slice(2, 5), [2, 3, 4], torch.arange(2, 5), torch.arange(5) > 1], ids=str
)
def test_rows_are_written_at_any_cursor(cursor: object) -> None:
    storage = FrameStorage(5)
    storage.set(range(5), episode(5))
    storage.set(cursor, episode(3, first=50))
    assert_identical(storage[:], torch.cat([episode(5)[:2], episode(3, first=50)]))


@pytest.mark.parametrize("cursor", [4, -1, torch.tensor(4)], ids=str)
def test_one_row_is_written_at_a_number(cursor: object) -> None:
    storage = FrameStorage(5)
    storage.set(range(5), episode(5))
    storage[cursor] = row(9, 60, 61)
    assert_identical(storage[4], row(9, 60, 61))


def test_the_rows_given_are_left_as_they_are() -> None:
    rows = episode(5)
    buffer_on(FrameStorage(5)).extend(rows)
    assert_identical(rows.exclude("index"), episode(5))
    locked = episode(5).lock_()
    FrameStorage(5).set(range(5), locked)
    assert_identical(locked, episode(5))


@pytest.mark.parametrize("kind", ["lazy stack", "list", "expanded"])
def test_rows_may_come_as(kind: str) -> None:
    rows = episode(4)
    given: object = {
        "lazy stack": LazyStackedTensorDict(*rows.unbind(0)),
        "list": list(rows.unbind(0)),
        "expanded": rows,
    }[kind]
    if kind == "expanded":
        rows = rows[:1].expand(4).clone()
        given = rows[:1].expand(4)
    storage = FrameStorage(4)
    storage.set(range(4), given)
    assert_identical(storage[:], rows)


def test_rewriting_rows_keeps_their_frames_where_they_are() -> None:
    storage = FrameStorage(8, extra_frames=1)
    storage.set(range(8), episode(8))
    rows = storage[[2, 6, 3]]
    rows["next", "reward"] += 100
    storage[[2, 6, 3]] = rows
    assert_identical(storage[[2, 6, 3]], rows)
    assert storage.frames_kept == 9


def test_a_robot_that_stands_still_needs_one_frame() -> None:
    storage = FrameStorage(50, extra_frames=0)
    storage.set(range(50), torch.stack([row(number, 8, 8) for number in range(50)]))
    assert storage.frames_kept == 1


def test_emptied_it_takes_new_rows() -> None:
    buffer = buffer_on(FrameStorage(6, extra_frames=1))
    buffer.extend(episode(6))
    buffer.empty()
    assert (len(buffer), buffer.storage.frames_kept) == (0, 0)
    buffer.extend(episode(6, first=70))
    assert_identical(buffer.storage[:].exclude("index"), episode(6, first=70))


@pytest.mark.parametrize("mapped", [False, True], ids=["in memory", "mapped"])
def test_a_deep_copy_goes_its_own_way(mapped: bool, tmp_path: Path) -> None:
    storage = wrapped(scratch_dir=tmp_path if mapped else None)
    rows, twin = storage[:], copy.deepcopy(storage)
    for first in (300, 400, 500):
        twin.set(range(10), episode(10, first))
    assert_identical(twin[:], episode(10, 500))
    assert_identical(twin[torch.arange(10)], episode(10, 500))
    assert twin.frames_kept == 11
    assert_identical(storage[:], rows)


def test_membership_and_shape_are_those_of_torchrls_storage() -> None:
    reference, storage = LazyTensorStorage(9), FrameStorage(9)
    for each in (reference, storage):
        each.set(range(7), episode(7))
    assert storage.shape == reference.shape
    assert storage.ndim == reference.ndim
    for index in (-8, -7, 0, 6, 7):
        assert (index in storage) == (index in reference)
    assert torch.equal(storage.contains(torch.tensor([0, 6, 7])), reference.contains(torch.tensor([0, 6, 7])))


# --- in place of TorchRL's storages


def filled(storage: object, **options: object) -> TensorDictReplayBuffer:
    buffer = buffer_on(storage, **{"transform": StampFuturePoses(6), **options})
    for batch in collect(420):
        buffer.extend(batch.clone())
    return buffer


@pytest.mark.parametrize("mapped", [False, True], ids=["in memory", "mapped"])
@pytest.mark.parametrize("sampler", [RandomSampler, SamplerWithoutReplacement])
@pytest.mark.parametrize("max_size", [1_000, 130])
def test_a_collectors_rows_are_sampled_bit_for_bit_as_from_torchrls_storage(
    max_size: int, sampler: Callable, mapped: bool, tmp_path: Path
) -> None:
    frames = filled(FrameStorage(max_size, scratch_dir=tmp_path if mapped else None), sampler=sampler())
    reference = filled(
        LazyMemmapStorage(max_size, scratch_dir=tmp_path / "reference") if mapped else LazyTensorStorage(max_size),
        sampler=sampler(),
    )
    assert len(frames) == len(reference) == min(max_size, 405)
    for _ in range(20):
        assert_identical(frames.sample(), reference.sample())
    assert_identical(frames[:], reference[:])


def test_a_collectors_rows_need_a_frame_each_and_the_last_of_the_episodes() -> None:
    buffer = filled(FrameStorage(130))
    rows = buffer[:]
    frames = torch.cat([rows["pixels"], rows["next", "pixels"]]).flatten(1).unique(dim=0)
    assert buffer.storage.frames_kept == len(frames)
    assert len(frames) <= 130 + rows["next", "done"].sum() + 3


def test_relabelled_samples_are_the_same_too() -> None:
    frames, reference = (
        filled(FrameStorage(200), transform=relabelling()),
        filled(LazyTensorStorage(200), transform=relabelling()),
    )
    sample = frames.sample()
    assert sample["goal", "mask"].any()
    assert_identical(sample, reference.sample())


def test_prefetching_buffers_read_it() -> None:
    stored = filled(FrameStorage(1_000)).storage[:]
    buffer = filled(FrameStorage(1_000), prefetch=2)
    for _ in range(5):
        sample = buffer.sample()
        assert_identical(sample, stored[sample["index"]])


def test_samplers_of_slices_read_it() -> None:
    def sampler() -> SliceSampler:
        return SliceSampler(num_slices=4, end_key=("next", "done"), truncated_key=None)

    frames, reference = (buffer_on(each, sampler=sampler()) for each in (FrameStorage(30), LazyTensorStorage(30)))
    for buffer in (frames, reference):
        for first in (0, 100, 200):
            buffer.extend(episode(12, first))
    torch.manual_seed(0)
    sample = frames.sample()
    torch.manual_seed(0)
    assert_identical(sample, reference.sample())


def test_a_writer_that_keeps_the_best_rows_writes_it() -> None:
    def fill(storage: object) -> TensorDictBase:
        buffer = buffer_on(storage, writer=TensorDictMaxValueWriter(rank_key=("next", "reward")))
        for first in (5, 40, 0, 20):
            buffer.extend(episode(6, first))
        buffer.extend(row(300, 90, 91).unsqueeze(0))
        return buffer.storage[:]

    assert_identical(fill(FrameStorage(9, extra_frames=9)), fill(LazyTensorStorage(9)))


def test_pixels_may_be_nested() -> None:
    rows = (
        episode(5).rename_key_("pixels", ("camera", "rgb")).rename_key_(("next", "pixels"), ("next", "camera", "rgb"))
    )
    storage = FrameStorage(5, keys=Keys(pixels=("camera", "rgb")))
    storage.set(range(5), rows)
    assert_identical(storage[:], rows)
    assert storage.frames_kept == 6


# --- checkpoints


def wrapped(**options: object) -> FrameStorage:
    """A ring that has wrapped, so that its rows are no longer in the order of its slots."""
    storage = FrameStorage(10, **options)
    for first in range(0, 70, 7):
        storage.set([(first + i) % 10 for i in range(7)], episode(7, 3 * first))
    return storage


@pytest.mark.parametrize(
    "target", [{}, {"mapped": True}, {"max_size": 25}, {"used": True}, {"extra_frames": 4}], ids=str
)
@pytest.mark.parametrize("way", ["state dict", "file"])
def test_a_checkpoint_restores_all_rows(target: dict, way: str, tmp_path: Path) -> None:
    saved = wrapped()
    restored = FrameStorage(
        target.get("max_size", 10),
        scratch_dir=tmp_path / "map" if "mapped" in target else None,
        extra_frames=target.get("extra_frames"),
    )
    if "used" in target:
        restored.set(range(5), episode(5, first=400))
    if way == "file":
        saved.dumps(tmp_path / "checkpoint")
        restored.loads(tmp_path / "checkpoint")
    else:
        restored.load_state_dict(saved.state_dict())
    assert_identical(restored[:], saved[:])
    assert (len(restored), restored.frames_kept) == (10, saved.frames_kept)
    restored.set([4, 5], episode(2, first=500))
    assert_identical(restored[[3, 4, 5]], torch.cat([saved[[3]], episode(2, first=500)]))


def test_a_buffer_resumes_from_a_checkpoint_with_the_same_samples(tmp_path: Path) -> None:
    buffer, restored = (buffer_on(FrameStorage(130), transform=StampFuturePoses(6)) for _ in range(2))
    batches = collect(420)
    for batch in batches[:12]:
        buffer.extend(batch.clone())
    buffer.dumps(tmp_path)
    restored.loads(tmp_path)
    assert_identical(restored[:], buffer[:])
    for batch in batches[12:]:
        for each in (buffer, restored):
            each.extend(batch.clone())
    assert_identical(restored.sample(), buffer.sample())


def test_a_storage_takes_its_own_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_storage, "CHUNK", 3)
    storage = wrapped()
    rows = storage[:]
    storage.load_state_dict(storage.state_dict())
    assert_identical(storage[:], rows)


def test_an_empty_storage_has_an_empty_state(tmp_path: Path) -> None:
    FrameStorage(10).dumps(tmp_path)
    storage = wrapped()
    storage.loads(tmp_path)
    assert (len(storage), storage.frames_kept, storage.state_dict()) == (0, 0, {})


def test_a_checkpoint_is_one_file_of_numbers(tmp_path: Path) -> None:
    wrapped().dumps(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["frame_storage.safetensors"]


def damaged(change: Callable) -> dict:
    state = wrapped().state_dict()
    state["rows"] = {**state["rows"], "next": dict(state["rows"]["next"])}
    change(state)
    return state


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.update(_storage=state.pop("rows")), "no state of a FrameStorage: it holds.*_storage"),
        (lambda state: state["rows"].update(pixels=state["rows"]["pixels"] + 20), "damaged"),
        (lambda state: state["rows"].update(pixels=state["rows"]["pixels"] - 20), "damaged"),
        (lambda state: state["rows"].update(pixels=state["rows"]["pixels"].float()), "damaged"),
        (lambda state: state.update(frames=state["frames"].int()), "damaged"),
        (lambda state: state.update(frames=state["frames"][:, :1]), r"frames of shape \(2, 5, 3\)"),
        (lambda state: state["rows"].update(pose=state["rows"]["pose"].double()), "holds pose as"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_and_the_rows_stay(change: Callable, message: str) -> None:
    storage = FrameStorage(10)
    storage.set(range(5), episode(5))
    with pytest.raises(ValueError, match=message):
        storage.load_state_dict(damaged(change))
    assert_identical(storage[:], episode(5))


def test_a_state_that_is_too_large_is_refused() -> None:
    with pytest.raises(ValueError, match="holds 10 rows, more than max_size=9"):
        FrameStorage(9).load_state_dict(wrapped().state_dict())
    with pytest.raises(ValueError, match=r"2 frames too many .*pass extra_frames=2"):
        FrameStorage(10, extra_frames=0).load_state_dict(wrapped().state_dict())


def test_a_missing_or_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no checkpoint of a FrameStorage at .*frame_storage\.safetensors"):
        FrameStorage(10).loads(tmp_path)
    (tmp_path / "frame_storage.safetensors").write_bytes(b"not at all")
    with pytest.raises(ValueError, match="is damaged"):
        FrameStorage(10).loads(tmp_path)
    save_file({json.dumps("other"): torch.zeros(1)}, tmp_path / "frame_storage.safetensors")
    with pytest.raises(ValueError, match="no state of a FrameStorage"):
        FrameStorage(10).loads(tmp_path)


def test_a_failed_checkpoint_leaves_the_last_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = wrapped()
    storage.dumps(tmp_path)
    rows = storage[:]

    def fail(tensors: dict, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError("no space left")

    storage.set([0], episode(1, first=600))
    monkeypatch.setattr(frame_checkpointer, "save_file", fail)
    with pytest.raises(OSError, match="no space left"):
        storage.dumps(tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    restored = FrameStorage(10)
    restored.loads(tmp_path)
    assert_identical(restored[:], rows)


def test_hooks_are_refused(tmp_path: Path) -> None:
    storage = wrapped()
    storage.register_save_hook(lambda data, path: data)
    with pytest.raises(ValueError, match="no hooks"):
        storage.dumps(tmp_path)


# --- sizes


def test_the_size_is_a_frame_a_row_and_the_other_entries() -> None:
    storage = FrameStorage(1_000, extra_frames=50)
    assert (storage.bytes_per_row, storage.nbytes) == (0, 0)
    storage.set(range(3), episode(3))
    size = 2 * 5 * 3 + OVERHEAD
    assert storage.bytes_per_row == ENTRIES + 2 * 8 + size
    assert storage.nbytes == 1_000 * storage.bytes_per_row + 50 * size


def test_what_is_allocated_is_what_is_stated() -> None:
    storage = FrameStorage(1_000, extra_frames=50)
    storage.set(range(3), episode(3))
    rows = sum(value.nbytes for value in storage._storage.values(True, True))
    assert rows + storage._table.frames.nbytes + 1_050 * OVERHEAD == storage.nbytes


def test_a_transition_at_64x64_takes_half_of_what_torchrl_takes() -> None:
    flags = {name: torch.zeros(2, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
    frames = torch.zeros(3, 64, 64, 3, dtype=torch.uint8)
    rows = TensorDict(
        {
            "pixels": frames[:-1],
            "pose": torch.zeros(2, 3),
            "action": torch.zeros(2, 2),
            "hindsight": {"pose": torch.zeros(2, 32, 3), "horizon": torch.zeros(2, 1, dtype=torch.int64)},
            **flags,
            "next": {"pixels": frames[1:], "pose": torch.zeros(2, 3), "reward": torch.zeros(2, 1), **flags},
        },
        batch_size=[2],
    )
    storage, torchrl = FrameStorage(100), LazyTensorStorage(100)
    for each in (storage, torchrl):
        each.set(range(2), rows)
    per_row = sum(value.nbytes for value in torchrl[0].values(True, True))
    assert storage.bytes_per_row == 12_288 + 2 * 8 + OVERHEAD + (per_row - 2 * 12_288)
    assert storage.bytes_per_row < 0.52 * per_row


@pytest.mark.parametrize(("max_size", "extra"), [(1, 1), (40, 40), (200, 64), (100_000, 10_000)])
def test_by_default_a_tenth_more_frames_than_rows(max_size: int, extra: int) -> None:
    assert FrameStorage(max_size).extra_frames == extra


def test_the_size_is_logged_before_anything_is_allocated(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(free_room, "free_memory", lambda: 0)
    storage = FrameStorage(1_000, extra_frames=50)
    with caplog.at_level(logging.INFO), pytest.raises(MemoryError):
        storage.set(range(3), episode(3))
    size = 2 * 5 * 3 + OVERHEAD
    nbytes = 1_000 * (ENTRIES + 2 * 8 + size) + 50 * size
    assert f"{nbytes / 1000:.4g} kB: max_size=1000 rows" in caplog.text


def test_too_little_memory_is_refused_with_the_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    storage = FrameStorage(1_000, extra_frames=50)
    monkeypatch.setattr(free_room, "free_memory", lambda: 12_345)
    with pytest.raises(MemoryError, match=r"\(\d{6} bytes\) in memory.*\(12345 bytes\) are free.*max_size=1000 rows"):
        storage.set(range(3), episode(3))
    assert (len(storage), storage.initialized) == (0, False)
    monkeypatch.undo()
    storage.set(range(3), episode(3))
    assert_identical(storage[:], episode(3))


def test_too_little_disk_is_refused_with_the_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = FrameStorage(1_000, extra_frames=50, scratch_dir=tmp_path / "new")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=12_345))
    with pytest.raises(MemoryError, match=r"in the disk of .*new, .*\(12345 bytes\) are free.*another scratch_dir"):
        storage.set(range(3), episode(3))
    assert list((tmp_path / "new").iterdir()) == []


def test_mapped_rows_need_little_memory_but_their_bookkeeping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = FrameStorage(1_000, extra_frames=50, scratch_dir=tmp_path)
    monkeypatch.setattr(free_room, "free_memory", lambda: 1_050 * OVERHEAD)
    storage.set(range(3), episode(3))
    monkeypatch.setattr(free_room, "free_memory", lambda: 1_050 * OVERHEAD - 1)
    with pytest.raises(MemoryError, match="in memory"):
        FrameStorage(1_000, extra_frames=50, scratch_dir=tmp_path).set(range(3), episode(3))


def test_free_memory_is_that_of_this_machine() -> None:
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0.001 * total < free_room.free_memory() < total


def test_mapped_files_are_gone_at_once_but_their_rows_are_not(tmp_path: Path) -> None:
    storage = wrapped(scratch_dir=tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert_identical(storage[:], wrapped()[:])
    mapped = Path("/proc/self/maps").read_text()
    assert f"{tmp_path}/frame_storage-" in mapped


def test_a_failure_while_mapping_leaves_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **options: object) -> None:
        raise OSError("no space left")

    storage = FrameStorage(10, scratch_dir=tmp_path)
    monkeypatch.setattr(torch, "from_file", fail)
    with pytest.raises(OSError, match="no space left"):
        storage.set(range(3), episode(3))
    assert list(tmp_path.iterdir()) == []
    assert not storage.initialized


# --- errors


@pytest.mark.parametrize(("arguments", "message"), [((0,), "max_size.*got 0"), ((5, -1), "extra_frames.*got -1")])
def test_impossible_sizes_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameStorage(arguments[0], extra_frames=arguments[1] if len(arguments) > 1 else None)


def test_too_many_frames_name_how_many_are_needed() -> None:
    storage = FrameStorage(6, extra_frames=2)
    rows = torch.cat([episode(2, first) for first in (0, 10, 20)])
    with pytest.raises(RuntimeError, match=r"these 6 rows.*extra_frames=2 it keeps 8.*pass extra_frames=3"):
        storage.set(range(6), rows)
    assert len(storage) == 0
    enough = FrameStorage(6, extra_frames=3)
    enough.set(range(6), rows)
    assert_identical(enough[:], rows)


def with_entry(key: object, value: Tensor) -> TensorDict:
    return episode(4).set(key, value)


@pytest.mark.parametrize(
    ("rows", "error", "message"),
    [
        (
            episode(4).exclude("pixels"),
            KeyError,
            r"misses the key pixels, set by keys=Keys\(pixels='pixels'\).*next.pixels",
        ),
        (episode(4).exclude(("next", "pixels")), KeyError, "misses the key next.pixels"),
        (episode(4).exclude("action"), KeyError, "have nothing and lack action"),
        (with_entry("extra", torch.zeros(4)), KeyError, "have extra and lack nothing"),
        (with_entry("pixels", torch.zeros(4, *SHAPE)), ValueError, "pixels is torch.float32"),
        (with_entry("pixels", torch.zeros(4, 5, 2, 3, dtype=torch.uint8)), ValueError, "must have one shape"),
        (with_entry("pose", torch.zeros(4, 5)), ValueError, r"pose as torch.float32 \(3,\).*torch.float32 \(5,\)"),
        (with_entry("pose", torch.zeros(4, 3).double()), ValueError, "it is torch.float64"),
        (episode(3), ValueError, r"batch size \(3,\) for places \(4,\)"),
        (episode(4).unsqueeze(1), ValueError, r"batch size \(4, 1\).*rows.reshape\(-1\)"),
        ({"pixels": 0}, TypeError, "keeps TensorDicts, got a dict"),
    ],
)
def test_rows_that_do_not_fit_are_refused_and_nothing_is_written(rows: object, error: type, message: str) -> None:
    storage = FrameStorage(5)
    storage.set(range(5), episode(5, first=30))
    with pytest.raises(error, match=message):
        storage.set(range(4), rows)
    assert_identical(storage[:], episode(5, first=30))
    assert storage.frames_kept == 6


def test_frames_of_another_shape_are_refused() -> None:
    storage = FrameStorage(5)
    storage.set(range(5), episode(5))
    rows = episode(5)
    for part in (rows, rows["next"]):
        part["pixels"] = torch.zeros(5, 3, 3, 3, dtype=torch.uint8)
    with pytest.raises(ValueError, match=r"frames of shape \(2, 5, 3\), these are \(3, 3, 3\)"):
        storage.set(range(5), rows)


@pytest.mark.parametrize("place", [5, -6])
def test_rows_beyond_the_storage_are_refused(place: int) -> None:
    with pytest.raises(IndexError, match=f"row {place} is beyond max_size=5"):
        FrameStorage(5).set([place], episode(1))


def test_reading_what_was_never_written_is_refused() -> None:
    storage = FrameStorage(5)
    with pytest.raises(RuntimeError, match="holds no rows yet"):
        storage[0]
    storage.set(3, row(1, 2, 3))
    assert_identical(storage[3], row(1, 2, 3))
    with pytest.raises(IndexError, match="never been written"):
        storage[:]
    with pytest.raises(IndexError):
        storage[4]


def test_it_says_what_it_holds() -> None:
    assert repr(FrameStorage(5)) == "FrameStorage(0 of max_size=5 rows, 0 frames, extra_frames=5, 0 bytes)"
    storage = FrameStorage(5)
    storage.set(range(3), episode(3))
    assert "3 of max_size=5 rows, 4 frames" in repr(storage)


def test_another_process_is_refused() -> None:
    process = multiprocessing.get_context("spawn").Process(target=len, args=(wrapped(),))
    with pytest.raises(RuntimeError, match="belongs to one process"):
        process.start()
