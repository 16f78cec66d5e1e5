"""What the compiler of torch is helped with."""

from __future__ import annotations

import sympy

from nsde_torch.export.ahead import quick_indices


def test_indices_are_expanded_quickly_and_sympy_is_itself_again_afterwards() -> None:
    before, i = sympy.simplify, sympy.Symbol("i", integer=True)
    with quick_indices():
        assert sympy.simplify(3 * (i + 1) + 2 - 3 * i) == 5
        assert sympy.simplify(sympy.sin(i) ** 2 + sympy.cos(i) ** 2) == 1  # not a polynomial: as ever
    assert sympy.simplify is before
