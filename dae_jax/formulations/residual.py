"""The equations as they are written, 0 = F(t, y, ẏ), for solvers that take them so."""

from typing import Any, ClassVar

import equinox as eqx

from ..equations.constraint_jacobian import Rank
from ..equations.independent import independent
from ..equations.linearised import LinearisedResidual
from ..equations.residual_form import Form, ResidualForm
from ..systems import System, is_mechanism
from ..types import Args, State, Time
from .interface import AbstractResidualFormulation


class Residual(AbstractResidualFormulation):
    """No equation is differentiated by hand: 0 = F(t, y, ẏ), for `RadauIIA5`, `RadauIIA9`, `RadauIIA13`, `Radau` and `BDF`.

    **Arguments**

    - `form`: for a `ConstrainedSystem`, "index-3", "index-2" or "GGL" (see `ResidualForm` for the equations); other
      systems are taken as they are.
    - `variable_index`: the index of each unknown, in the order of `ResidualForm.variables`. The error of a variable of
      index k counts with h^(k−1) in step-size control. By default found by structural analysis. Where it is given, the
      equations are taken as they are also where a solver need not converge for them.
    """

    inverts_mass: ClassVar[bool] = False
    needs_independent: ClassVar[bool] = True

    form: Form = eqx.field(static=True, default="GGL")
    variable_index: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.form not in ("index-3", "index-2", "GGL"):
            raise ValueError(f'`form` must be "index-3", "index-2" or "GGL", but is {self.form!r}.')

    def named(self, system: System) -> str:
        return f'Residual("{self.form}")' if is_mechanism(system) else "Residual"

    @property
    def keeps(self) -> tuple[bool, bool]:
        return self.form != "index-2", self.form != "index-3"

    def encode(
        self, system: System, t: Time, state: State, args: Args = None, rank: int | Rank | None = None
    ) -> tuple[Any, LinearisedResidual]:
        if rank is not None:
            system = independent(system, t, state, args, rank)
        form = ResidualForm.of(system, t, state, args, self.form)
        if self.variable_index is not None and len(self.variable_index) != form.size:
            raise ValueError(
                f"`variable_index` must have a number for each of {', '.join(form.variables)}: {form.size} in all, but has "
                f"{len(self.variable_index)}."
            )
        form, y = form.at_start(t, state)
        linearised = LinearisedResidual.of(form, y, self.variable_index)
        return y, linearised.starting(t, y)


def GGL() -> Residual:
    """The stabilised index-2 form of Gear, Gupta and Leimkuhler: the constraint and its derivative both hold, with an extra
    multiplier η that vanishes for the exact solution.
    """
    return Residual("GGL")
