"""The environments as TorchRL and Gymnasium environments."""
