"""Values and intervals from positions alone where the laws are told, on the cases of `position_only`.

Each case is identified with the true effects declared, from first values that are 30 % off. It counts how many 90 %
intervals hold the truth, by machine, and how far estimates are off in half-widths.

    python benchmarks/blind/position_values.py --seed 6007 --count 48 --out runs/position_values
"""

from __future__ import annotations

import sys
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from position_only import recorded
from study import Json, answers, options

OFF = 1.3
"""First values over the true ones."""


def case(seed: int, i: int) -> dict[str, Any]:
    """Make and identify one case; nothing to identify where there is no effect."""
    import torch

    from nsde_torch.sysid import identify_in_loop
    from nsde_torch.systems import make_system

    torch.set_num_threads(1)
    system, truth, data, told = recorded(seed, i, full=False, how="none")
    true = {f"{e}.{n}": float(x) for e, values in truth.items() for n, x in values.items()}
    off: dict[str, float | None] = {}
    if true:
        values = {label: OFF * value for label, value in true.items()}
        found = identify_in_loop(make_system(system, effects=list(truth), values=values), data.runs)
        half = found.half_widths(0.9)
        for label, value in true.items():
            j = found.vector.labels.index(label)
            off[label] = float((found.values[j] - value) / half[j]) if np.isfinite(half[j]) else None
    return {"case": i, "system": system, **told, "truth": true, "off": off}


def main() -> None:
    """Identifies cases one after another, and counts."""
    a = options("Values from positions alone, the laws told.", count=48).parse_args()

    def line(answer: Json) -> str:
        return f"{answer['case']} {answer.get('system')} {answer.get('off')} {answer.get('error') or ''}"

    cases = [
        (f"seed_{a.seed}_case_{i:03d}", partial(case, a.seed, i), {"case": i, "off": {}})
        for i in range(a.first, a.first + a.count)
    ]
    by_system: dict[str, list[float]] = defaultdict(list)
    for answer in answers(a.out, cases, line):
        by_system[str(answer.get("system"))] += [v for v in answer["off"].values() if v is not None]
    for system, off in by_system.items():
        away = np.array(off)
        if len(away):
            print(
                f"{system}: {int((np.abs(away) <= 1).sum())} of {len(away)} intervals hold; half-widths off: "
                f"mean {away.mean():+.2f}, rms {np.sqrt(np.mean(away**2)):.2f}"
            )


if __name__ == "__main__":
    main()
