import pytest
import torch

from halgan_rl.transforms import MirrorRows
from tests.transforms.rows import assert_identical, random_source, sampled_rows


def test_images_are_flipped_left_to_right_and_sideways_actions_reversed() -> None:
    rows = sampled_rows(6)
    mirrored = MirrorRows(1.0, generator=random_source())(rows)
    for key in ("pixels", ("next", "pixels")):
        expected = torch.stack([rows[key][:, :, column] for column in (4, 3, 2, 1, 0)], dim=2)
        assert torch.equal(mirrored[key], expected)
        assert not torch.equal(mirrored[key], rows[key])
    assert torch.equal(mirrored["action"], rows["action"] * torch.tensor([1.0, -1.0]))


def test_the_signs_choose_which_entries_reverse() -> None:
    mirrored = MirrorRows(1.0, generator=random_source(), action_signs=(-1.0, 1.0))(rows := sampled_rows(6))
    assert torch.equal(mirrored["action"], rows["action"] * torch.tensor([-1.0, 1.0]))


def test_a_mirror_twice_is_no_mirror() -> None:
    mirror = MirrorRows(1.0, generator=random_source())
    assert_identical(mirror(mirror(rows := sampled_rows(6))), rows)


def test_probability_zero_is_the_identity_bit_for_bit() -> None:
    assert_identical(MirrorRows(0.0, generator=random_source())(rows := sampled_rows(6)), rows)


def test_a_row_is_mirrored_as_a_whole_and_as_often_as_asked() -> None:
    rows = sampled_rows(2_000)
    mirrored = MirrorRows(0.3, generator=random_source())(rows)
    by_image = (mirrored["pixels"] != rows["pixels"]).flatten(1).any(1)
    by_next_image = (mirrored["next", "pixels"] != rows["next", "pixels"]).flatten(1).any(1)
    by_action = (mirrored["action"] != rows["action"]).any(1)
    assert torch.equal(by_image, by_next_image)
    assert torch.equal(by_image[1:], by_action[1:])  # the first row's action is zero
    assert 0.25 < by_image.float().mean() < 0.35


def test_the_random_state_round_trips_through_the_state_dict() -> None:
    first = MirrorRows(0.5, generator=random_source(1))
    first(rows := sampled_rows(64))
    second = MirrorRows(0.5, generator=random_source(2))
    second.load_state_dict(first.state_dict())
    assert_identical(second(rows), first(rows))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"probability": 1.5}, r"\[0, 1\], got 1.5"), ({"action_signs": (1.0, 0.5)}, r"1 or -1, got \(1.0, 0.5\)")],
)
def test_values_that_mean_nothing_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MirrorRows(generator=random_source(), **arguments)


def test_actions_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="Actions have 2 entries, action_signs has 3"):
        MirrorRows(generator=random_source(), action_signs=(1.0, 1.0, -1.0))(sampled_rows(6))
