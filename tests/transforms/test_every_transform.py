"""What holds for every transform: add one to ``rows.CASES`` and it is tested here."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import Compose, StepCounter, TransformedEnv

from halgan_rl import transforms
from tests.toy import Parking
from tests.transforms.rows import (
    CASES,
    NESTED,
    SAMPLING,
    Case,
    assert_identical,
    leaves,
    rename,
    sampled_rows,
)

EVERY = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
ON_SAMPLING = pytest.mark.parametrize("case", SAMPLING.values(), ids=SAMPLING.keys())
ATTACH = {
    "constructor": lambda transform: TransformedEnv(Parking(), transform),
    "append_transform": lambda transform: TransformedEnv(Parking(), StepCounter()).append_transform(transform),
    "Compose": lambda transform: TransformedEnv(Parking(), Compose(StepCounter(), transform)),
}
READS = [
    pytest.param(case, field, key, id=f"{name}-{field}-{key}")
    for name, case in CASES.items()
    for field, keys in case.reads.items()
    for key in keys
]


def rows_for(case: Case) -> TensorDictBase:
    """Rows that the transform has not seen; on the write path they must be consecutive steps."""
    rows = case.prepare(sampled_rows())
    if case.on_write:
        rows = rows.exclude("hindsight", "goal")
        rows["pose"] = torch.cat([rows["pose"][:1], rows["next", "pose"][:-1]])
    return rows


def test_every_public_transform_is_tested_here() -> None:
    tested = {type(case.make()).__name__ for case in CASES.values()}
    public = {name for name in transforms.__all__ if issubclass(getattr(transforms, name), transforms.ReplayTransform)}
    assert tested == public - {"ReplayTransform"}


@EVERY
@pytest.mark.parametrize("attach", ATTACH.values(), ids=ATTACH.keys())
def test_an_environment_is_refused_with_the_remedy(case: Case, attach: Callable) -> None:
    transform = case.make()
    with pytest.raises(TypeError, match=rf"^{type(transform).__name__} .*replay_buffer\.append_transform"):
        attach(transform)


@pytest.mark.parametrize(("case", "field", "key"), READS)
def test_a_missing_key_is_named_together_with_the_field_that_set_it(case: Case, field: str, key: object) -> None:
    transform = case.make()
    with pytest.raises(KeyError) as error:
        case.apply(transform, rows_for(case).exclude(key))
    name = key if isinstance(key, str) else ".".join(key)
    assert f"misses the key {name}, set by keys=Keys({field}='{field}'). The rows hold " in str(error.value)


@EVERY
def test_nested_keys_do_the_same(case: Case) -> None:
    flat = case.apply(case.make(), rows_for(case))
    nested = case.apply(case.make(keys=NESTED), rename(rows_for(case)))
    assert_identical(nested, rename(flat))


@EVERY
def test_the_rows_given_are_not_modified(case: Case) -> None:
    rows = rows_for(case)
    before = rows.clone()
    case.apply(case.make(), rows)
    assert_identical(rows, before)


@EVERY
def test_no_gradient_is_recorded(case: Case) -> None:
    rows = rows_for(case)
    for key in ("pose", ("next", "pose"), ("next", "reward")):
        rows[key] = rows[key].requires_grad_()
    out = case.apply(case.make(), rows)
    assert all(value.grad_fn is None for value in leaves(out).values())


@EVERY
def test_the_global_random_state_is_neither_read_nor_advanced(case: Case) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = case.apply(case.make(), rows_for(case))
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert_identical(case.apply(case.make(), rows_for(case)), first)


@ON_SAMPLING
def test_only_the_entries_named_are_written(case: Case) -> None:
    rows = rows_for(case)
    out = case.make()(rows)
    assert_identical(out.exclude(*case.writes), rows.exclude(*case.writes))
    assert all(not torch.equal(out[key], rows[key]) for key in case.writes)


@ON_SAMPLING
def test_unmasked_rows_are_untouched_bit_for_bit(case: Case) -> None:
    rows = rows_for(case)
    out = case.make()(rows)
    mask = out["goal", "mask"].squeeze(-1)
    assert 0 < mask.sum() < len(rows)
    assert_identical(out[~mask].exclude("goal"), rows[~mask].exclude("goal"))


@ON_SAMPLING
def test_no_shape_depends_on_the_mask(case: Case) -> None:
    def shapes(mask: bool) -> dict:
        rows = rows_for(case)
        rows["goal", "mask"] = torch.full_like(rows["goal", "mask"], mask)
        rows["hindsight", "horizon"] = rows["hindsight", "horizon"] * mask
        return {key: (value.shape, value.dtype) for key, value in leaves(case.make()(rows)).items()}

    assert shapes(False) == shapes(True)


@ON_SAMPLING
def test_batches_of_two_dimensions_do_the_same(case: Case) -> None:
    rows = rows_for(case)
    assert_identical(case.make()(rows.reshape(3, 4)).reshape(12), case.make()(rows))


@ON_SAMPLING
def test_a_single_row_may_be_read_by_its_index(case: Case) -> None:
    rows = rows_for(case)
    assert_identical(case.make()(rows[4]).unsqueeze(0), case.make()(rows[4:5]))


@ON_SAMPLING
@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("buffer_class", [ReplayBuffer, TensorDictReplayBuffer])
@pytest.mark.parametrize("slack", [0, 3], ids=["full", "not full"])
def test_the_storage_is_never_modified(case: Case, storage: type, buffer_class: type, slack: int) -> None:
    buffer = buffer_class(storage=storage(12 + slack), batch_size=8)
    buffer.extend(rows_for(case))
    before = buffer[:].clone()
    addresses = {key: value.data_ptr() for key, value in leaves(buffer[:]).items()}
    buffer.append_transform(case.make())
    read = [buffer[:], buffer[1:11], buffer[torch.arange(12)], buffer[4], buffer.sample()]
    assert any(not torch.equal(leaves(out)[k], v) for out in read for k, v in leaves(before[: len(out)]).items())
    buffer._transform.pop()
    assert_identical(buffer[:], before)
    assert {key: value.data_ptr() for key, value in leaves(buffer[:]).items()} == addresses


@pytest.mark.parametrize("name", ["HallucinateGoal(fixed_shape)", "HindsightReward"])
def test_it_compiles_to_one_graph(name: str) -> None:
    transform, rows = CASES[name].make(), sampled_rows()
    compiled = torch.compile(transform, fullgraph=True, backend="eager")
    assert_identical(compiled(rows), transform(rows))
