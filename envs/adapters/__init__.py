"""Adapters: the environments as TorchRL and as Gymnasium environments."""
