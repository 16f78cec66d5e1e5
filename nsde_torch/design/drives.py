"""What turns the rows of a plan into inputs while an experiment runs."""

from __future__ import annotations

from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.design.rollout import Drive

Array = NDArray[np.float64]


@final
class OpenLoop:
    """Inputs as the plan has them, whatever the machine does."""

    def __call__(self, tables: Array) -> Drive:
        """Inputs of plans (B, N, nu)."""
        u = torch.as_tensor(tables)

        def drive(k: int, measured: Tensor) -> Tensor:
            return u[:, k]

        return drive
