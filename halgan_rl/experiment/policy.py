"""Saved policies: networks with a manifest that says how they are rebuilt."""

from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from halgan_rl.agents.registry import policy_of
from halgan_rl.hallucination.weights import load_module, read_manifest


def load_policy(path: Path) -> tuple[TensorDictModuleBase, dict[str, Any]]:
    """Rebuilds the deterministic policy of a run.

    Args:
        path: ``policy.safetensors`` of its folder; the manifest lies beside it.

    Returns:
        The policy, on the CPU, and its manifest, which names its ``environment``.

    Raises:
        FileNotFoundError: if weights or manifest are missing.
        ValueError: if a file is damaged, or holds no policy of a known algorithm.
    """
    manifest = read_manifest(path)
    for field in ("kind", "environment"):
        if not isinstance(manifest.get(field), str):
            raise ValueError(f"{path.with_suffix('.json')} lacks {field!r}: it is no manifest of a policy")
    algorithm = policy_of(manifest["kind"])
    network, manifest = load_module(path, algorithm.network)
    return algorithm.make_policy(network), manifest
