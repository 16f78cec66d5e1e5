"""A fit that its guard does not believe, once more over longer boxes.

A noise model learns what a smoother, a differentiated encoder or a friction does within a few rows, and with it the
physics: the likelihood of many rows a second prefers it so. Sums over longer boxes do not hold that band, and both
sides of the equation go through the same one. So, where least squares, the first values or a parameter that has gone
to nothing speak against a fit (and no fault of the log does), it is made again with boxes of `LENGTHS_S`. It is taken
where the guard believes it at both lengths. Two things grow with the length of the boxes: what inputs answer within
one of them (feedback), and what is lost of fast physics. So intervals widen by what parameters change from the one to
the other, which is no less than a bias that grows as the root of the length or faster.
"""

from nsde_torch.sysid.guard import Guarded

LENGTHS_S = (0.05, 0.2)
"""Length of the boxes, and of those that they are held against [s]: a bias as the root of the length doubles."""
LONGER = 2.0
"""Times the length of the boxes before that the first must have."""


def asks_for_longer_boxes(guard: Guarded | None) -> bool:
    """Whether what speaks against a fit is what its noise model may have learned."""
    kinds = {"least_squares", "first_values", "gone"}
    return guard is not None and bool(guard.objections) and {o.kind for o in guard.objections} <= kinds


def in_words(box_s: float, guard: Guarded) -> dict[str, str]:
    """What was done, and the remedy, for a person."""
    why = "; ".join(o.sentence for o in guard.objections)
    return {
        "sentence": f"means over {box_s:.3g} s are fitted: nothing speaks against these; over shorter ones, {why}",
        "remedy": f"intervals are widened by what changes with means over {LENGTHS_S[1]:.3g} s. The states may have "
        "been smoothed or filtered before they were logged, or something that acts is not declared: log raw sensors; "
        "`nsde diagnose` names effects",
    }
