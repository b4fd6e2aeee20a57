"""Which folder is installed as which package; everything else about the project is in ``pyproject.toml``.

The folder ``envs`` is installed as ``halgan_envs``: a package called ``envs`` would collide with other people's.
"""

from setuptools import find_packages, setup

setup(
    packages=[
        *find_packages(include=["halgan_rl", "halgan_rl.*"]),
        "halgan_envs",
        *(f"halgan_envs.{name}" for name in find_packages("envs")),
    ],
    package_dir={"halgan_envs": "envs"},
)
