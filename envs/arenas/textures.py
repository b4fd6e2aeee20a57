"""Procedural textures: images drawn by numpy from a seed, so that nothing has to be downloaded."""

from typing import Any

import imageio.v3 as imageio
import numpy as np
from dm_control import mjcf

_GREY = 0.36
"""Colour of asphalt without stains and marks."""


def png_asset(image: np.ndarray) -> Any:
    """Returns an image as a file that MJCF textures can name.

    Args:
        image: Colours in [0, 1], float [H, W, 3].
    """
    pixels = (255 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
    return mjcf.Asset(imageio.imwrite("<bytes>", pixels, extension=".png"), ".png")


def asphalt(size: tuple[float, float], road: tuple[float, float], random_state: np.random.RandomState) -> np.ndarray:
    """Returns a used road from above: stains, patches, cracks, worn wheel tracks and lane marks.

    Args:
        size: Of the whole ground in x and y [m]; the road runs along x through its middle.
        road: Of the road between its kerbs in x and y [m].
        random_state: Source of all that is irregular.

    Returns:
        float [H, W, 3], a pixel a centimetre; rows run along y, columns along x.
    """
    x, y = (np.arange(round(100 * length)) / 100 - length / 2 for length in size)
    shape = (len(y), len(x))
    grey = _GREY + sum(
        strength * _smooth_noise(shape, cells, random_state)
        for cells, strength in ((6, 0.05), (25, 0.04), (90, 0.05), (300, 0.09), (max(shape), 0.06))
    )
    grey = grey + _wheel_tracks(y, road[1])[:, None]
    grey = grey * _stains(x, y, random_state)
    grey = grey * _patches(shape, random_state)
    grey = grey * _cracks(shape, random_state)
    image = grey[..., None] * np.array([1.0, 0.99, 0.97])
    paint = _lane_marks(x, y, road) * np.clip(0.85 + 0.6 * _smooth_noise(shape, 60, random_state), 0.0, 1.0)
    return image + paint[..., None] * (np.array([0.82, 0.81, 0.77]) - image)


def bricks(colour: tuple[float, ...], mortar: float, random_state: np.random.RandomState) -> np.ndarray:
    """Returns eight courses of bricks of slightly different colour, float [128, 128, 3].

    Args:
        colour: Of a brick.
        mortar: Grey of what is between them.
        random_state: Source of the differences.
    """
    rows, columns = np.mgrid[:128, :128]
    course = rows // 16
    shifted = (columns + 16 * (course % 2)) % 128
    shade = random_state.uniform(0.8, 1.15, size=(8, 4))[course, shifted // 32]
    image = shade[..., None] * np.array(colour)
    image[(rows % 16 < 2) | (shifted % 32 < 2)] = mortar
    return image


def planks(colour: tuple[float, ...], random_state: np.random.RandomState) -> np.ndarray:
    """Returns four boards with grain, float [64, 64, 3]."""
    shade = random_state.uniform(0.8, 1.1, size=4)[np.arange(64) // 16][:, None] * np.ones(64)
    shade *= 1 + 0.25 * _smooth_noise((64, 64), 12, random_state)
    shade[np.arange(64) % 16 == 0] *= 0.5
    return shade[..., None] * np.array(colour)


def leaves(colour: tuple[float, ...], random_state: np.random.RandomState) -> np.ndarray:
    """Returns a hedge, float [128, 128, 3]."""
    shade = 1 + 0.6 * _smooth_noise((128, 128), 20, random_state) + 0.6 * _smooth_noise((128, 128), 60, random_state)
    return shade[..., None] * np.array(colour)


def stripes(one: tuple[float, ...], other: tuple[float, ...]) -> np.ndarray:
    """Returns slanted stripes of two colours, as on a barrier, float [64, 64, 3]."""
    rows, columns = np.mgrid[:64, :64]
    return np.where(((rows + columns) % 64 < 32)[..., None], one, other)


def _smooth_noise(shape: tuple[int, int], cells: int, random_state: np.random.RandomState) -> np.ndarray:
    # Values in [-1, 1] on a coarse grid with that many cells along the longer side, interpolated linearly.
    scale = cells / max(shape)
    coarse = random_state.uniform(-1, 1, size=[int(np.ceil(length * scale)) + 2 for length in shape])
    (row, row_share), (column, column_share) = (_split(np.arange(length) * scale) for length in shape)
    rows = coarse[row] * (1 - row_share)[:, None] + coarse[row + 1] * row_share[:, None]
    return rows[:, column] * (1 - column_share) + rows[:, column + 1] * column_share


def _split(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    whole = position.astype(int)
    return whole, position - whole


def _wheel_tracks(y: np.ndarray, width: float) -> np.ndarray:
    lanes = np.array([-0.36, -0.14, 0.14, 0.36]) * width
    return 0.05 * np.exp(-np.square((y[:, None] - lanes) / 0.12)).sum(axis=1)


def _stains(x: np.ndarray, y: np.ndarray, random_state: np.random.RandomState) -> np.ndarray:
    clean = np.ones((len(y), len(x)))
    for _ in range(14):
        at_x, at_y = random_state.uniform(x[0], x[-1]), random_state.uniform(y[0], y[-1])
        size = random_state.uniform(0.05, 0.25, size=2)
        blob = np.exp(-np.square((x - at_x) / size[0]) - np.square((y[:, None] - at_y) / size[1]))
        clean *= 1 - random_state.uniform(0.2, 0.5) * blob
    return clean


def _patches(shape: tuple[int, int], random_state: np.random.RandomState) -> np.ndarray:
    old = np.ones(shape)
    for _ in range(9):
        row, column = (random_state.randint(length) for length in shape)
        height, width = random_state.randint(30, 90), random_state.randint(40, 140)
        old[row : row + height, column : column + width] *= random_state.choice([0.65, 0.78, 1.22])
    return old


def _cracks(shape: tuple[int, int], random_state: np.random.RandomState) -> np.ndarray:
    whole = np.ones(shape)
    for _ in range(12):
        length = random_state.randint(80, 260)
        heading = random_state.uniform(0, 2 * np.pi) + np.cumsum(random_state.normal(0, 0.2, size=length))
        rows = random_state.randint(shape[0]) + np.cumsum(np.sin(heading))
        columns = random_state.randint(shape[1]) + np.cumsum(np.cos(heading))
        whole[rows.astype(int).clip(0, shape[0] - 1), columns.astype(int).clip(0, shape[1] - 1)] = 0.45
    return whole


def _lane_marks(x: np.ndarray, y: np.ndarray, road: tuple[float, float]) -> np.ndarray:
    dashes = (np.abs(y) < 0.04)[:, None] & (x % 1.2 < 0.6)
    edges = (np.abs(np.abs(y) - (road[1] / 2 - 0.12)) < 0.03)[:, None] & (np.abs(x) < np.inf)
    return (dashes | edges).astype(float)
