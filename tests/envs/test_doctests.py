"""The examples in the docstrings of halgan_envs, run under its installed name: by path they would be a second copy."""

import doctest
import importlib
import pkgutil

import pytest

import halgan_envs

MODULES = ["halgan_envs", *(module.name for module in pkgutil.walk_packages(halgan_envs.__path__, "halgan_envs."))]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_each_module_run(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_there_are_examples():
    find = doctest.DocTestFinder(exclude_empty=True).find
    assert sum(bool(test.examples) for name in MODULES for test in find(importlib.import_module(name))) >= 10
