"""The implicit trapezoidal rule."""

from .implicit import AbstractImplicitSolver, Tableau


_TABLEAU = Tableau([[0, 0], [1 / 2, 1 / 2]], [1 / 2, 1 / 2])


class Trapezoid(AbstractImplicitSolver):
    """y₁ = y₀ + h/2 (f(y₀) + f(y₁)): order 2, A-stable, symmetric. Fixed steps."""

    @property
    def tableau(self) -> Tableau:
        return _TABLEAU

    def order(self, terms: object) -> int:
        return 2
