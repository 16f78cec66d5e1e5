"""A policy: the mean action of a Gaussian, from a small network of the observation.

    a = clip(W_n tanh(... tanh(W_1 (o / scale) + b_1) ...) + b_n, -1, 1)

Its file holds tensors and, in the header, plain words (safetensors): a file is read without running code.
"""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, final

import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from nsde_torch.errors import CheckpointError
from nsde_torch.whole_files import read_tensors, write_tensors

POLICY = "policy.safetensors"
_FORMAT = "nsde_torch/policy/1"


@final
class Actor(nn.Module):
    """A policy of a system, of what it sees over its scale (no,), with hidden layers of some widths (tanh)."""

    def __init__(self, scale: Sequence[float], hidden: Sequence[int], n_actions: int, *, system: str) -> None:
        super().__init__()
        self.system, self.hidden = system, tuple(hidden)
        self.scale: Tensor
        self.register_buffer("scale", torch.tensor(list(scale)))
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise([len(scale), *hidden, n_actions]))
        # The spread of the actions that learning explores with; an evaluation goes by the mean alone.
        self.log_std = nn.Parameter(torch.zeros(n_actions))

    def forward(self, observation: Tensor) -> Tensor:
        """Actions (N, na) in [-1, 1] for what is seen (N, no)."""
        y = observation / self.scale
        for layer in self.layers[:-1]:
            y = torch.tanh(layer(y))
        action: Tensor = self.layers[-1](y)
        return action.clamp(-1.0, 1.0)

    def save(self, folder: str | Path) -> Path:
        """Write `policy.safetensors` into a folder; returns its path."""
        path = Path(folder) / POLICY
        about = {"system": self.system, "hidden": list(self.hidden), "n_actions": len(self.log_std)}
        write_tensors(path, self.state_dict(), {"format": _FORMAT, "about": json.dumps(about)})
        return path


def load_policy(folder: str | Path) -> Actor:
    """The policy that `nsde policy` wrote into a folder.

    Raises:
        CheckpointError: there is none, or it is damaged.

    Example:
        >>> policy = load_policy("runs/policy")  # doctest: +SKIP
        >>> action = policy(observation)  # doctest: +SKIP
    """
    path = Path(folder) / POLICY
    if not path.is_file():
        raise CheckpointError(f"no policy {path}; give the folder that `nsde policy` printed.")
    try:
        tensors, metadata = read_tensors(path)
        if metadata.get("format") != _FORMAT:
            raise CheckpointError(f"{path} is not of the format {_FORMAT}; another version wrote it.")
        about: dict[str, Any] = json.loads(metadata["about"])
        scale, system = tensors["scale"].tolist(), str(about["system"])
        actor = Actor(scale, about["hidden"], about["n_actions"], system=system)
        actor.load_state_dict(tensors)
    except (SafetensorError, OSError, LookupError, TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path} is damaged ({error}). Train the policy again.") from error
    if not all(bool(torch.isfinite(v).all()) for v in tensors.values()):
        raise CheckpointError(f"{path} holds numbers that are not finite. Train the policy again.")
    return actor.eval().requires_grad_(False)
