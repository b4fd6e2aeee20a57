import torch

from halgan_rl.transforms.pixels import to_float, to_uint8


def test_every_level_survives_the_round_trip() -> None:
    levels = torch.arange(256, dtype=torch.uint8).reshape(1, 16, 16, 1).expand(2, -1, -1, 3)
    assert torch.equal(to_uint8(to_float(levels)), levels)


def test_levels_are_rounded_not_cut_off() -> None:
    image = torch.full((1, 3, 1, 1), 99.6 / 127.5 - 1)
    assert to_uint8(image).flatten().tolist() == [100, 100, 100]


def test_values_outside_the_range_are_clipped() -> None:
    assert to_uint8(torch.tensor([-1.5, 0.0, 1.5]).reshape(1, 3, 1, 1)).flatten().tolist() == [0, 128, 255]


def test_floats_lie_in_channels_last_and_span_the_range() -> None:
    pixels = torch.zeros(2, 5, 8, 8, 3, dtype=torch.uint8)
    pixels[..., 0] = 255
    images = to_float(pixels)
    assert images.shape == (10, 3, 8, 8)
    assert images.is_contiguous(memory_format=torch.channels_last)
    assert images[:, 0].unique().tolist() == [1.0]
    assert images[:, 1:].unique().tolist() == [-1.0]
    assert pixels.float().mean() == 85  # untouched
