"""Gauss–Legendre collocation with two stages."""

from .implicit import AbstractImplicitSolver, Tableau


_ROOT = 3**0.5 / 6
_TABLEAU = Tableau([[1 / 4, 1 / 4 - _ROOT], [1 / 4 + _ROOT, 1 / 4]], [1 / 2, 1 / 2])


class Gauss4(AbstractImplicitSolver):
    """The Gauss method of order 4: A-stable, symmetric, symplectic. Fixed steps.

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, table IV.5.1.
    """

    @property
    def tableau(self) -> Tableau:
        return _TABLEAU

    def order(self, terms: object) -> int:
        return 4
