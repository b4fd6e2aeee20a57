import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

from halgan_rl.keys import dotted
from halgan_rl.transforms import HallucinateGoal
from tests import toy
from tests.transforms.rows import assert_identical, invert, sampled_rows

MASKED = [1, 2, 3, 4, 7, 8, 9, 10]


class Recorder:
    """A hallucinator that remembers what it was given."""

    def __init__(self) -> None:
        self.calls: list[tuple[Tensor, Tensor, Tensor]] = []

    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        self.calls.append((pixels, pose, goal_pose))
        return pixels


class Painter(nn.Module):
    """A hallucinator that is a network, as careless users pass it."""

    def __init__(self) -> None:
        super().__init__()
        self.brush = nn.Linear(3, 3)

    def forward(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        assert not torch.is_grad_enabled()
        return pixels + self.brush(pose)[..., :1, None, None].abs().ceil().to(torch.uint8)


def test_masked_rows_get_what_the_hallucinator_makes_of_their_own_frames_and_poses() -> None:
    rows = sampled_rows()
    out = HallucinateGoal(invert)(rows)
    for at in MASKED:
        goal = rows["goal", "pose"][at]
        assert torch.equal(out["pixels"][at], invert(rows["pixels"][at], rows["pose"][at], goal))
        after = rows["next"][at]
        assert torch.equal(out["next", "pixels"][at], invert(after["pixels"], after["pose"], goal))


def test_both_paths_give_equal_results() -> None:
    assert_identical(HallucinateGoal(invert)(sampled_rows()), HallucinateGoal(invert, fixed_shape=True)(sampled_rows()))


def test_only_masked_rows_are_hallucinated_both_frames_in_one_call() -> None:
    rows, recorder = sampled_rows(), Recorder()
    HallucinateGoal(recorder)(rows)
    [(pixels, pose, goal_pose)] = recorder.calls
    assert torch.equal(pixels, torch.stack([rows["pixels"], rows["next", "pixels"]], 1)[MASKED])
    assert torch.equal(pose, torch.stack([rows["pose"], rows["next", "pose"]], 1)[MASKED])
    assert torch.equal(goal_pose, rows["goal", "pose"][MASKED, None])


def paint_by_goal(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """Brighten one value of frames: by the goal's x in the first frame, and by its y in the second."""
    painted = pixels.clone()
    painted[..., 3, 4, 1] = goal_pose[:, 0, :2].to(torch.uint8)
    return painted


@pytest.mark.parametrize("fixed_shape", [False, True])
def test_a_goal_that_the_first_image_does_not_show_is_given_up_if_asked(fixed_shape: bool) -> None:
    rows = sampled_rows()
    rows["pixels"].zero_()
    rows["next", "pixels"].zero_()
    rows["goal", "pose"][:, 0], rows["goal", "pose"][:, 1] = 17, 0  # seen, then lost
    faint, late = MASKED[:3], MASKED[5:6]
    rows["goal", "pose"][faint, 0] = 16
    rows["goal", "pose"][late] = torch.tensor([0.0, 255.0, 0.0])  # comes into view
    out = HallucinateGoal(paint_by_goal, pursue_unseen=False, fixed_shape=fixed_shape)(rows.clone())
    pursued = [at for at in MASKED if at not in faint + late]
    assert out["goal", "mask"].flatten().nonzero().flatten().tolist() == pursued
    assert out["pixels"].flatten(1).any(1).nonzero().flatten().tolist() == pursued
    assert not out["next", "pixels"].any()
    asked_for_all = HallucinateGoal(paint_by_goal, fixed_shape=fixed_shape)(rows.clone())
    assert torch.equal(asked_for_all["goal", "mask"], rows["goal", "mask"])
    assert asked_for_all["next", "pixels"][late].any()


@pytest.mark.parametrize(("darker", "seen"), [(17, MASKED), (16, []), (1, [])])
def test_darker_is_seen_as_well_as_brighter(darker: int, seen: list[int]) -> None:
    rows = sampled_rows()
    rows["pixels"].fill_(200)
    out = HallucinateGoal(lambda pixels, *_: pixels - darker, pursue_unseen=False)(rows)
    assert out["goal", "mask"].flatten().nonzero().flatten().tolist() == seen


def test_nothing_is_hallucinated_when_no_row_is_masked() -> None:
    rows, recorder = sampled_rows(), Recorder()
    rows["goal", "mask"].zero_()
    assert_identical(HallucinateGoal(recorder)(rows), rows)
    assert not recorder.calls


def test_with_fixed_shapes_the_hallucinator_always_sees_all_rows() -> None:
    recorder = Recorder()
    for mask in (False, True):
        rows = sampled_rows()
        rows["goal", "mask"].fill_(mask)
        HallucinateGoal(recorder, fixed_shape=True)(rows)
    assert [call[0].shape for call in recorder.calls] == [(12, 2, 4, 5, 3)] * 2


def test_an_exact_hallucinator_shows_what_would_have_been_seen() -> None:
    pose = torch.tensor([[0.0, 0.0, 0.0], [3.0, -2.0, torch.pi / 2]])
    elsewhere, goal = torch.tensor([[1.0, 1.0, 0.0]]), torch.tensor([[4.0, 1.0, torch.pi]])
    seen = toy.hallucinate(toy.render(pose, elsewhere), pose, goal)
    assert torch.equal(seen, toy.render(pose, goal))
    assert not torch.equal(seen, toy.render(pose, elsewhere))


def test_a_network_stays_out_of_the_buffers_state_and_keeps_its_mode() -> None:
    painter = Painter().train()
    transform = HallucinateGoal(painter)
    buffer = ReplayBuffer(storage=LazyTensorStorage(12), batch_size=6)
    buffer.extend(sampled_rows())
    buffer.append_transform(transform)
    buffer.sample()
    assert painter.training
    assert not list(transform.parameters())
    assert not buffer.state_dict()["_transforms"]


def test_no_gradient_reaches_a_network() -> None:
    assert not HallucinateGoal(Painter())(sampled_rows())["pixels"].requires_grad


@pytest.mark.parametrize(
    ("wrong", "returned"),
    [
        (lambda pixels, pose, goal_pose: pixels / 255, r"torch\.float32 \(8, 2, 4, 5, 3\)"),
        (lambda pixels, pose, goal_pose: pixels[:, 0], r"torch\.uint8 \(8, 4, 5, 3\)"),
    ],
    ids=["dtype", "shape"],
)
def test_a_hallucinator_that_returns_something_else_is_named(wrong: object, returned: str) -> None:
    with pytest.raises(ValueError, match=rf"must return .* torch\.uint8 \(8, 2, 4, 5, 3\), but returned {returned}"):
        HallucinateGoal(wrong)(sampled_rows())


def test_what_cannot_be_called_is_refused() -> None:
    with pytest.raises(TypeError, match=r"must be callable .*'generator\.safetensors'"):
        HallucinateGoal("generator.safetensors")


def written(shape: tuple[int, ...], dtype: torch.dtype = torch.uint8, key: object = "pixels") -> TensorDict:
    """Rows ``[2, 7]`` as an environment writes them, with other images under one key."""
    rows = TensorDict({"pixels": torch.zeros(2, 7, 84, 60, 3, dtype=torch.uint8)}, batch_size=[2, 7])
    rows["next"] = TensorDict({"pixels": rows["pixels"]}, batch_size=[2, 7])
    rows[key] = torch.zeros(2, 7, *shape, dtype=dtype)
    return rows


BOTH = pytest.mark.parametrize("key", ["pixels", ("next", "pixels")], ids=["root", "next"])


class PaintsOneShape:
    """A hallucinator that knows its images."""

    def __init__(self, *image_shape: int) -> None:
        self.image_shape = image_shape

    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        return pixels


@pytest.mark.parametrize("shape", [(84, 84, 3), (64, 64, 1), (64, 48, 12), (5, 4, 4)])
@pytest.mark.parametrize("knows", [False, True])
def test_images_of_any_size_and_channels_may_be_written(shape: tuple[int, ...], knows: bool) -> None:
    rows = written(shape)
    rows["next", "pixels"] = rows["pixels"]
    hallucinator = PaintsOneShape(*shape) if knows else invert
    assert_identical(HallucinateGoal(hallucinator).inv(rows), rows)


@BOTH
@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
def test_images_that_are_not_uint8_are_refused_when_they_are_written(dtype: torch.dtype, key: object) -> None:
    with pytest.raises(ValueError, match=rf"the entry {dotted(key)} is {dtype}, .*uint8.*without ToTensorImage"):
        HallucinateGoal(invert).inv(written((84, 60, 3), dtype, key))


@BOTH
@pytest.mark.parametrize("shape", [(3, 84, 60), (12, 84, 84), (1, 64, 64)])
def test_images_with_their_channels_first_are_refused_when_they_are_written(shape: tuple, key: object) -> None:
    with pytest.raises(ValueError, match=rf"the entry {dotted(key)} has images \({shape[0]}, .*PermuteTransform\(dims"):
        HallucinateGoal(invert).inv(written(shape, key=key))


@BOTH
@pytest.mark.parametrize("shape", [(4, 84, 60, 3), (84, 60)])
def test_images_of_another_rank_are_refused_when_they_are_written(shape: tuple, key: object) -> None:
    with pytest.raises(ValueError, match=rf"the entry {dotted(key)} has images \({shape[0]}, .*CatFrames\(N, dim=-1\)"):
        HallucinateGoal(invert).inv(written(shape, key=key))


@BOTH
def test_images_that_the_hallucinator_does_not_paint_are_refused_when_they_are_written(key: object) -> None:
    with pytest.raises(ValueError, match=rf"the entry {dotted(key)} has images \(64, 64, 3\), .* paints \(84, 60, 3\)"):
        HallucinateGoal(PaintsOneShape(84, 60, 3)).inv(written((64, 64, 3), key=key))


def test_images_of_another_shape_after_the_step_are_refused_when_they_are_written() -> None:
    with pytest.raises(ValueError, match=r"next\.pixels has images \(60, 84, 3\), but pixels has \(84, 60, 3\)"):
        HallucinateGoal(invert).inv(written((60, 84, 3), key=("next", "pixels")))


def test_a_hallucinator_that_says_so_paints_images_of_any_rank() -> None:
    rows = written((4, 84, 60, 3))
    rows["next", "pixels"] = rows["pixels"]
    HallucinateGoal(PaintsOneShape(4, 84, 60, 3)).inv(rows)


def test_a_refused_batch_leaves_the_buffer_empty() -> None:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(14), transform=HallucinateGoal(invert))
    with pytest.raises(ValueError, match="PermuteTransform"):
        buffer.extend(written((3, 84, 60)).reshape(14))
    assert len(buffer) == 0


@pytest.mark.parametrize("shape", [(12, 3, 4, 5, 3), (12, 20), (12, 4, 5)])
def test_fixed_shapes_select_rows_whatever_the_rank_of_images(shape: tuple[int, ...]) -> None:
    def darken(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        return 255 - pixels

    rows = sampled_rows()
    rows["pixels"] = torch.arange(math.prod(shape)).remainder(200).reshape(shape).to(torch.uint8)
    rows["next", "pixels"] = rows["pixels"] + 7
    fixed = HallucinateGoal(darken, fixed_shape=True)(rows)
    assert_identical(fixed, HallucinateGoal(darken)(rows))
    changed = (fixed["pixels"] != rows["pixels"]).flatten(1).any(1)
    assert changed.nonzero().flatten().tolist() == MASKED
