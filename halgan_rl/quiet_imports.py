"""Importing this module imports TorchRL's collectors without the four warnings that TorchRL gives of its own classes.

``torchrl.collectors`` derives four classes from one that it deprecates, and warns of each: lines on which no user of
this package can act, in every process. Exactly those are left out; the filters of the process stay as they are.
"""

import importlib
import warnings

OWN_CLASSES = r"Creating (Vanilla|MultiProcessed|RemoteModule|Ray)WeightUpdater which inherits from WeightUpdaterBase"
"""Pattern of the four messages; of a user's own subclass TorchRL warns as before."""

importlib.import_module("torchrl.envs")  # Outside: filters that torch sets for itself outlast the block.
with warnings.catch_warnings():
    warnings.filterwarnings("ignore", OWN_CLASSES, DeprecationWarning)
    importlib.import_module("torchrl.collectors")
