"""The implicit midpoint rule."""

from .implicit import AbstractImplicitSolver, Tableau


_TABLEAU = Tableau([[1 / 2]], [1.0])


class Midpoint(AbstractImplicitSolver):
    """y₁ = y₀ + h f((y₀ + y₁)/2): order 2, A-stable, symmetric, symplectic. Fixed steps."""

    @property
    def tableau(self) -> Tableau:
        return _TABLEAU

    def order(self, terms: object) -> int:
        return 2
