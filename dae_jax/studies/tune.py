"""`tune`: gradient descent on positive parameters, many starts at once."""

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..compiler import at_ease
from ..tables import table
from ..validate.states import NUMBERS, brief, counted, describe
from ..validate.user_functions import at_numbers, refuse_untraceable
from .progress import Progress


if TYPE_CHECKING:  # half of the time that importing the library takes beyond diffrax
    import optax


# Up to this many parameters the derivative is taken in forward mode first: one tangent for each.
FEW = 8
# So many steps are one compiled call.
BLOCK = 10
# Where steps gain nothing any more, as they go to and fro across a valley, they become so many times shorter, and this often.
SHORTER, LEVELS = 8.0, 2

Map: TypeAlias = Callable[..., Any]


class History(NamedTuple):
    """A descent, step by step; every array has the leading axes (starts, steps).

    - `loss`: where the descent was; `best`: the lowest loss until there.
    - `params`: where it was.
    - `gradient_norm`: |∂loss/∂log(params)|, before clipping.
    """

    loss: Float[Array, "starts steps"]
    best: Float[Array, "starts steps"]
    params: PyTree
    gradient_norm: Float[Array, "starts steps"]

    def __repr__(self) -> str:
        """What it holds, in a line."""
        starts, steps = self.loss.shape
        return f"History(starts={starts}, steps={steps}, loss={self.loss[0, 0]:.6g} → {np.min(self.best):.6g})"


class Tuned(NamedTuple):
    """What `tune` returns.

    - `params`, `loss`: the best point that any start visited, and its loss.
    - `history`: see `History`.
    - `evaluations`: what it cost, in evaluations of the loss: for each step one and, in forward mode, one for each
      parameter (in reverse mode three, about what it costs).
    """

    params: PyTree
    loss: Float[Array, ""]
    history: History
    evaluations: int

    def __repr__(self) -> str:
        """The point, what was gained and at what cost, in a line."""
        params = jax.tree.map(_short, self.params)
        return f"Tuned(params={params}, loss={self.loss:.6g}, history={self.history}, evaluations={self.evaluations})"

    def _repr_html_(self) -> str:
        """A table for a notebook."""
        starts, steps = self.history.loss.shape
        return table(
            "Tuned",
            {
                "params": str(jax.tree.map(_short, self.params)),
                "loss": f"{self.history.loss[0, 0]:.6g} → {self.loss:.6g}",
                "descent": f"{counted(starts, 'start')}, {counted(steps, 'step')}, {counted(self.evaluations, 'evaluation')}",
            },
        )


class _Point(NamedTuple):
    """Where a descent is. `first`: the first finite loss; `mark`: the best when it was last lower by enough, `stale` steps ago; `rough`:
    whether it has gone up since; `level`: how often its steps have become shorter.
    """

    z: Float[Array, " parameters"]
    state: Any
    best_z: Float[Array, " parameters"]
    best: Float[Array, ""]
    first: Float[Array, ""]
    mark: Float[Array, ""]
    stale: Any
    rough: Any
    level: Any


@at_ease
@at_numbers
def tune(
    loss: Callable[[Any], Any],
    params: PyTree,
    optimiser: "optax.GradientTransformation | None" = None,
    *,
    steps: int,
    starts: int = 1,
    progress: bool = True,
    spread: float = 10.0,
    patience: int = 30,
    tolerance: float = 1e-3,
    key: Any = None,
) -> Tuned:
    """Minimises loss(p) over positive parameters p by descent on z = log p:

        z ← z + optimiser(∂loss/∂z),

    so that a step changes every parameter by a factor and none becomes negative. By default a loss in another unit, or with another
    constant added, is the same loss.

    **Arguments**

    - `loss`: a JAX function of `params` to a real number. Where the gradient comes from: up to 8 parameters forward
      mode, else reverse mode, and the other mode where JAX refuses the first. A `daesolve` inside it needs
      `adjoint=diffrax.ForwardMode()` for forward mode.
    - `params`: any pytree of positive numbers: the first start.
    - `optimiser`: any optax optimiser, also one that searches along a line (what that evaluates is not counted); by default the gradient
      clipped to norm 1, then Adam with Nesterov's momentum and a rate that falls from 0.3 to 0.01 along a cosine.
    - `steps`: at most so many. Where within `patience` steps a start has not lowered its loss by a part `tolerance` of it, or of what it
      has lowered it by in all, whichever is less, it goes on from its best point in steps 8 times shorter, twice; ends earlier where
      these gain nothing either, or no step led up.
    - `starts`: how many descents run at once, batched. The others begin at `params` times factors drawn from
      1/`spread` to `spread`, uniformly in the logarithm, with `key`.
    - `progress`: whether a bar is shown on stderr.

    A point where the loss or its gradient is not finite, or a parameter too large or too small for a positive number, is never the
    best, and the descent goes half-way back to its best point.

    **Returns** a `Tuned`.

    Errors: `ValueError` for parameters that are not positive, for a loss that is no real number or not traceable, where it is finite
    nowhere, and within `jit`, `vmap` and `grad` of what is looked at.
    """
    for tuned in descent(  # noqa: B007
        loss, params, optimiser, steps=steps, starts=starts, progress=progress, spread=spread, patience=patience,
        tolerance=tolerance, key=key,
    ):  # fmt: skip
        pass
    return tuned


def descent(
    loss: Callable[[Any], Any],
    params: PyTree,
    optimiser: "optax.GradientTransformation | None" = None,
    *,
    steps: int,
    starts: int = 1,
    progress: bool = True,
    spread: float = 10.0,
    patience: int = 30,
    tolerance: float = 1e-3,
    key: Any = None,
) -> Iterator[Tuned]:
    """`tune`, with what was found so far after every few steps."""
    if not callable(loss):
        raise TypeError(f"`loss` must be a function of the parameters, but is {brief(loss)}.")
    _refuse_wrong_options(optimiser, spread, tolerance, key, steps=steps, starts=starts, patience=patience)
    if not jax.tree.leaves(params):
        raise ValueError(f"`params` must hold numbers, but is {params}.")
    logs, unravel = ravel_pytree(jax.tree.map(_checked_log, params))
    import optax

    if optimiser is None:
        rate = optax.cosine_decay_schedule(0.3, steps, 0.01 / 0.3)
        # Beside the gradient of a loss in any unit; the square of what is smaller is zero.
        least = float(jnp.finfo(logs.dtype).tiny) ** 0.5
        optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.nadam(rate, b2=0.95, eps=least))
    key = jax.random.key(0) if key is None else key
    factors = jax.random.uniform(key, (starts, logs.size), logs.dtype, -1, 1) * jnp.log(spread)
    z = logs + factors.at[0].set(0)
    point_at = lambda z: unravel(jnp.exp(z))
    value_at = lambda z: loss(point_at(z))
    derivative, cost = _value_and_gradient(value_at, logs)
    # Some take the value besides the gradient, or search along a line.
    update = optax.with_extra_args_support(optimiser).update
    advice = lambda f, df, state, z: update(df, state, z, value=f, grad=df, value_fn=value_at)
    advance = _compiled(derivative, point_at, advice, tolerance, patience)
    unknown = jnp.asarray(jnp.inf, z.dtype)
    point = jax.vmap(lambda z: _Point(z, optimiser.init(z), z, unknown, unknown, unknown, 0, False, 0))(z)
    records = []
    with Progress("tune", steps, progress) as shown:
        for done in range(0, steps, BLOCK):
            point, record = advance(point, min(BLOCK, steps - done))
            records.append(jax.tree.map(np.asarray, record))
            best = float(jnp.min(point.best))
            if not np.isfinite(best):
                raise ValueError(
                    f"`loss` or its gradient is not finite at any of the first {min(BLOCK, steps)} points."
                )
            settled = int(jnp.min(point.level)) > LEVELS
            shown.total = min(done + BLOCK, steps) if settled else steps
            shown.show(min(done + BLOCK, steps), f"best {best:.6g}{settled * ', settled'}")
            history = History(*jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x, axis=1)), *records))
            winner = int(jnp.argmin(point.best))
            found = jax.tree.map(jnp.asarray, point_at(point.best_z[winner]))
            yield Tuned(found, point.best[winner], history, history.loss.size * cost)
            if settled:
                return


def _short(x: Any) -> Any:
    """A number to six digits, a few of them as a list, many as their shape."""
    x = np.asarray(x)
    if x.size > FEW:
        return f"{x.dtype}{list(x.shape)}"
    return np.vectorize(lambda number: float(f"{number:.6g}"), otypes=[float])(x).tolist()


def _refuse_wrong_options(optimiser: Any, spread: float, tolerance: float, key: Any, **counts: int) -> None:
    for name, count in counts.items():
        if not isinstance(count, int | np.integer) or count < 1:
            raise ValueError(f"`{name}` must be a whole number of at least 1, but is {count!r}.")
    if not 1 <= spread < np.inf:
        raise ValueError(f"`spread` must be a factor of at least 1, but is {spread}.")
    if not 0 <= tolerance < 1:
        raise ValueError(f"`tolerance` must be a part of the loss, from 0 to 1, but is {tolerance}.")
    if optimiser is not None and not (hasattr(optimiser, "init") and hasattr(optimiser, "update")):
        raise TypeError(f"`optimiser` must be one of optax, such as optax.adam(0.1), but is {brief(optimiser)}.")
    if key is not None and not isinstance(key, jax.Array):
        raise TypeError(f"`key` must be one of `jax.random.key(...)`, but is {brief(key)}.")


def _checked_log(p: Any) -> Any:
    numbers = isinstance(p, NUMBERS) and np.isrealobj(np.asarray(p))
    if not numbers or not np.all(np.asarray(p) > 0) or not np.all(np.isfinite(np.asarray(p))):
        raise ValueError(f"`params` must be positive and finite, but hold {p}.")
    return jnp.log(jnp.asarray(p, jnp.result_type(float, p)))


def _value_and_gradient(f: Map, z: Any) -> tuple[Map, int]:
    """z → (f, ∂f/∂z) in the mode that suits and that JAX allows for f, and its cost in evaluations of f."""

    def forward(z: Any) -> Any:
        gradient, value = jax.jacfwd(lambda z: (f(z),) * 2, has_aux=True)(z)
        return value, gradient

    modes = [(forward, 1 + z.size), (jax.value_and_grad(f), 4)]
    first, second = modes if z.size <= FEW else modes[::-1]
    with refuse_untraceable("loss"):
        shape = jax.eval_shape(f, z)
    if getattr(shape, "shape", None) != () or not jnp.issubdtype(shape.dtype, jnp.floating):
        raise ValueError(f"`loss` must return a real number, but returns {describe(shape)}.")
    try:
        jax.eval_shape(first[0], z)
    except (TypeError, ValueError, NotImplementedError):
        # Refused: diffrax's adjoints allow one mode each. If the second is refused too, that error is the one to see.
        return second
    return first


def _compiled(derivative: Map, point_at: Map, advice: Map, tolerance: float, patience: int) -> Map:
    def step(point: _Point, _: Any) -> tuple[_Point, Any]:
        value, gradient = derivative(point.z)
        params = jax.tree.leaves(point_at(point.z))
        inside = jnp.all(jnp.stack([jnp.all((x > 0) & (x < jnp.inf)) for x in params]))
        fine = inside & jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
        better = fine & (value < point.best)
        # The first finite loss is lower by any measure.
        first = jnp.where(better & jnp.isinf(point.first), value, point.first)
        enough = lambda value: tolerance * jnp.minimum(first - value, jnp.abs(value))
        improved = better & ~(point.mark - value <= enough(value))
        update, state = advice(value, gradient, point.state, point.z)
        best_z, best = jnp.where(better, point.z, point.best_z), jnp.where(better, value, point.best)
        stale = jnp.where(improved, 0, point.stale + 1)
        tired = stale >= patience
        rough = ~improved & (point.rough | ~(value - best <= enough(best)))
        onward = jnp.where(fine, point.z + SHORTER**-point.level * update, (point.z + best_z) / 2)
        after = _Point(
            jnp.where(tired, best_z, onward),
            jax.tree.map(lambda a, b: jnp.where(fine, a, b), state, point.state),
            best_z,
            best,
            first,
            jnp.where(improved, value, point.mark),
            jnp.where(tired, 0, stale),
            rough & ~tired,
            point.level + jnp.where(tired, jnp.where(rough, 1, LEVELS + 1), 0),
        )
        return after, (value, best, point_at(point.z), jnp.linalg.norm(gradient))

    @functools.partial(jax.jit, static_argnums=1)
    def advance(point: _Point, count: int) -> tuple[_Point, Any]:
        return jax.vmap(lambda p: jax.lax.scan(step, p, length=count))(point)

    return advance
