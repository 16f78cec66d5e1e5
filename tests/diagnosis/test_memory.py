"""What a diagnosis holds at once, in units of the data that it is made of."""

import platform
from pathlib import Path

import numpy as np
import pytest

from nsde_torch.diagnosis.pipeline import give_back


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other C libraries keep no such memory, or do not say"
)
def test_freed_memory_between_pieces_in_use_is_given_back() -> None:
    def resident() -> int:
        return 4096 * int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])

    pieces = [np.ones(8000) for _ in range(4000)]  # 256 MB, below the size that is mapped by itself
    kept = pieces[::20]
    del pieces
    before = resident()
    give_back()
    assert len(kept) == 200
    assert before - resident() > 100e6
