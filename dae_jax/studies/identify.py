"""`identify`: parameters from measured data by least squares, with what the data say of them."""

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jax.scipy.special import gammaincc
from jaxtyping import Array, Bool, Float, PyTree

from .._compat import nondifferentiable
from ..compiler import at_ease
from ..solution import AccuracyWarning
from ..types import BoolScalar, DType, Scalar
from ..validate.states import NUMBERS, brief, describe
from .identified import Identified, named


if TYPE_CHECKING:  # a seventh of the time that importing the library takes beyond diffrax
    from .least_squares import Factors, Minimum

# A positive parameter that has fallen to this part of its start is on its way to 0.
LOST = 1e-6
# Where JAX refuses.
ADVICE = "a `daesolve` in it needs `adjoint=diffrax.ForwardMode()`."
# Where what `identify` returns is differentiated.
NO_DERIVATIVE = (
    "`identify` has no derivative by the data or by what `model` takes besides. That of the estimate is the solution of "
    "d(Jᵀr) = 0 at `found.params`."
)
# Where the model is not finite at its start.
AT_THE_START = (
    " So it is at the start, `params`: of a solve that failed with `throw=False`, or of a time that it did not reach, there are "
    "no numbers."
)


class Failed(NamedTuple):
    """Whether the descent did not come to an end, and whether that is at a maximum of |r|², or a saddle."""

    unfinished: BoolScalar
    peaked: BoolScalar


@at_ease
def identify(
    model: Callable[[Any], Any],
    params: PyTree,
    data: PyTree,
    sigma: PyTree = None,
    *,
    positive: PyTree = True,
    steps: int = 100,
    tolerance: float = 1e-3,
) -> Identified:
    """Parameters p by which a model is nearest to measured data d, and how well the data determine them:

        minimise |r|²/2,    r = (d − model(p))/σ,        covariance σ² (JᵀJ)⁻¹,    J = ∂model/∂p,

    by the Levenberg–Marquardt method, with as many digits as `params` has. J comes with the model in one pass of forward
    directions, one for each parameter. The standard errors are those of independent normal noise of one size and of a model that
    is linear over them.

    **Arguments**

    - `model`: a JAX function of `params` to what was measured, any pytree of arrays. A `daesolve` in it takes
      `adjoint=diffrax.ForwardMode()`; with `throw=False` parameters on the way at which it fails are turned down. Its tolerance
      should be small beside the noise: a derivative is as accurate as the solve. Its `AccuracyWarning`s are those of
      `model(found.params)`.
    - `params`: any pytree of numbers: the start. What is found is the minimum that it leads to.
    - `data`: what was measured, in the structure of what `model` returns, with all numbers finite: what is missing is left out of
      both.
    - `sigma`: the standard deviation of the noise, a number or a pytree of them in the structure of `data` or of its upper part
      ({"angle": 0.01, "force": 2.0}). If `None`, one for all data, estimated from the residuals.
    - `positive`: whether parameters are positive, and are sought as log p, so that none becomes negative: one boolean, or some in
      the structure of `params` or of its upper part.
    - `steps`: at most so many evaluations of the model and its derivatives.
    - `tolerance`: how near to the minimum the end is, in standard errors.

    **Returns** an `Identified`.

    Warns by an `AccuracyWarning` of what the data do not determine, by name of the parameters or of the combination of them,
    and of residuals larger than `sigma` allows. Such parameters keep what they were at the start, along the combination.

    Errors: `ValueError` or `TypeError` for data, parameters or a model that are not finite, not real, or not of the shape they
    should have; `RuntimeError` where the minimum was not found, or what was found is a maximum, or a solve with `throw=True` failed
    on the way. Under `jit` and `vmap` there is no warning, and NaN in place of an error: a batch of
    experiments is `jax.vmap(lambda d: identify(model, params, d))(data)`. It has no derivative.

    Sources: G. A. F. Seber, C. J. Wild, *Nonlinear Regression*, ch. 2 and 3; that of the method and its end in
    `dae_jax/studies/least_squares.py`.
    """
    if not callable(model):
        raise TypeError(f"`model` must be a function of the parameters, but is {brief(model)}.")
    if steps < 1 or not tolerance > 0:
        raise ValueError(f"`steps` and `tolerance` must be positive, but are {steps} and {tolerance}.")
    params = _numbers("params", params)
    data = _numbers("data", data)
    in_log = _in_log(params, positive)
    sigmas = None if sigma is None else _deviations(sigma, data)
    _refuse_too_few(params, data, sigma is None)
    run = jax.jit(lambda p, d, s: _identified(model, p, d, s, in_log, steps, tolerance))
    try:
        found, failed = run(params, data, sigmas)
    except TypeError as error:
        if "forward-mode" in str(error):
            raise TypeError(f"`model` has no forward derivative: {ADVICE}") from error
        raise
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((found, failed))):
        _refuse_failure(model, params, found, failed, steps)
        _warn(found)
        return found
    lost = failed.unfinished | failed.peaked
    return jax.tree.map(lambda x: jnp.where(lost, jnp.nan, x) if jnp.issubdtype(x.dtype, jnp.inexact) else x, found)


def _identified(
    model: Callable[[Any], Any],
    params: PyTree,
    data: PyTree,
    sigmas: PyTree | None,
    in_log: Bool[np.ndarray, " p"],
    steps: int,
    tolerance: float,
) -> tuple[Identified, Failed]:
    """What was found, and whether it is no minimum."""
    from .least_squares import minimum

    p, unravel = ravel_pytree(params)
    measured, unravel_data = ravel_pytree(data)
    dtype = min((leaf.dtype for leaf in jax.tree.leaves(params)), key=lambda dtype: jnp.finfo(dtype).bits)
    # Squares of data that are very small or large would be 0 or infinite.
    largest = jnp.max(jnp.abs(measured), initial=0)
    unit = jnp.where(largest > 0, largest, 1)
    weights = (1 / unit).astype(dtype)
    if sigmas is not None:
        sigma = ravel_pytree(sigmas)[0]
        # One that is traced is looked at here.
        weights = jnp.where(sigma > 0, 1 / sigma, jnp.nan).astype(dtype)
    at = lambda z: unravel(jnp.where(in_log, jnp.exp(z), z).astype(p.dtype))

    def value_and_jacobian(z: Float[Array, " p"]) -> tuple[Array, Array]:
        def off(z: Float[Array, " p"]) -> Array:
            given = model(at(z))
            _refuse_another_shape(given, data)
            _refuse_fewer_digits(given, dtype)
            return weights * (ravel_pytree(given)[0] - measured).astype(dtype)

        jacobian, r = jax.jacfwd(lambda z: (off(z),) * 2, has_aux=True)(z)
        return r, jacobian

    start = jnp.where(in_log, jnp.log(jnp.where(in_log, p, 1)), p).astype(dtype)
    magnitude = jnp.linalg.norm(weights * measured.astype(dtype))
    end = minimum(
        value_and_jacobian, start, known=sigmas is not None, magnitude=magnitude, tolerance=tolerance, steps=steps
    )
    finite = jnp.all(jnp.isfinite(end.jacobian)) & jnp.all(jnp.isfinite(end.residual))
    failed = Failed(~(end.converged & finite), ~end.bent)
    unit = 1.0 if sigmas is not None else unit.astype(dtype)
    found = _statistics(end, at(end.x), in_log, sigmas is not None, unit)
    residuals = unravel_data((-end.residual / weights).astype(measured.dtype))
    # Of a descent in which J stands for its own change, derivatives would be those of a linear model.
    return nondifferentiable(found._replace(residuals=residuals), msg=NO_DERIVATIVE), failed


def _statistics(
    end: "Minimum", params: PyTree, in_log: Bool[np.ndarray, " p"], known: bool, unit: Scalar | float
) -> Identified:
    """All but the residuals in units of the data. `unit`: that of the residuals."""
    from .least_squares import factors

    values, unravel = ravel_pytree(params)
    r, jacobian = end.residual, end.jacobian
    # With fewer data than parameters, directions that no datum sees have no row.
    rows = jnp.concatenate([jacobian, jnp.zeros((max(0, values.size - r.size), values.size), r.dtype)])
    found = factors(rows)
    free = r.size - jnp.sum(found.seen)
    free = jnp.where(free > 0, free, jnp.nan)
    square = r @ r
    deviation = jnp.sqrt(square / free)
    variance = 1.0 if known else deviation**2
    # In units of the columns of J, and one factor after the other: in float32 squares of 1e-23, a molecule's mass, are 0.
    inverse, unit_of = variance * _inverse(found), jnp.where(in_log, values, 1) / found.scale
    correlated = jnp.sqrt(jnp.diag(inverse))
    products = jnp.where(correlated > 0, correlated, jnp.nan)
    errors = jnp.abs(unit_of) * correlated
    scaled = jacobian / found.scale
    return Identified(
        params=params,
        standard_errors=unravel(errors.astype(values.dtype)),
        covariance=unit_of[:, None] * inverse * unit_of,
        correlation=inverse / (products[:, None] * products),
        information=(scaled.T @ scaled) / (unit_of[:, None] * variance) / unit_of,
        deviation=deviation * unit,
        residuals=r,
        cost=square / 2 * unit**2,
        iterations=end.steps,
        offset=end.offset,
        sensitivities=jnp.where(jnp.any(jacobian != 0, 0), found.scale, 0) * unit,
        singular_values=found.s,
        combinations=found.vt,
        in_log=jnp.asarray(in_log),
        probability=gammaincc(free / 2, square / 2) if known else jnp.asarray(jnp.nan),
    )


def _inverse(found: "Factors") -> Float[Array, "p p"]:
    """(JᵀJ)⁻¹ in units of J's columns; of parameters in a combination that is not seen ∞, and NaN beside others."""
    seen, v = found.seen > 0, found.vt.T
    inverse = (v * jnp.where(seen, 1 / jnp.where(seen, found.s, 1) ** 2, 0)) @ v.T
    half = jnp.sqrt(jnp.finfo(found.s.dtype).eps)
    lost = jnp.any(~seen[:, None] & (jnp.abs(found.vt) > half), 0)
    either = lost[:, None] | lost
    return jnp.where(either, jnp.where(jnp.eye(lost.size, dtype=bool), jnp.inf, jnp.nan), inverse)


# What is given


def _numbers(what: str, tree: PyTree) -> PyTree:
    """As arrays of floating-point numbers."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    if not leaves:
        raise ValueError(f"`{what}` must hold numbers, but is empty: {brief(tree)}.")
    for path, leaf in leaves:
        if not isinstance(leaf, NUMBERS) or jnp.iscomplexobj(leaf):
            raise TypeError(f"{_at(what, path)} must be real numbers, but holds {brief(leaf)}.")
        if np.ma.is_masked(leaf):
            raise TypeError(
                f"{_at(what, path)} has a mask: leave what is masked out of the data and of what `model` returns."
            )
        _refuse_not_finite(what, path, leaf)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float, x)), tree)


def _at(what: str, path: tuple[Any, ...], index: tuple[int, ...] = ()) -> str:
    name = named(path, index)
    return f"`{what}` at {name}" if name else f"`{what}`"


def _refuse_not_finite(what: str, path: tuple[Any, ...], leaf: Any, advice: str = "") -> None:
    if isinstance(leaf, Tracer) or np.all(np.isfinite(leaf)):
        return
    first = tuple(int(k) for k in np.argwhere(~np.isfinite(leaf))[0])
    raise ValueError(f"{_at(what, path, first)} must be finite, but is {np.asarray(leaf)[first]}.{advice}")


def _in_log(params: PyTree, positive: PyTree) -> Bool[np.ndarray, " p"]:
    """Which entries are sought as logarithms."""
    asked = _spread("positive", positive, params, "booleans")
    flags = []
    for (path, p), log in zip(jax.tree_util.tree_leaves_with_path(params), jax.tree.leaves(asked), strict=True):
        if not isinstance(log, bool | np.bool_):
            raise TypeError(f"`positive` must hold booleans, one for each array of parameters, but holds {brief(log)}.")
        if log and not isinstance(p, Tracer) and not np.all(np.asarray(p) > 0):
            raise ValueError(
                f"{_at('params', path)} must be positive, but holds {np.min(p):g}. Pass `positive=False`, or booleans in the "
                "structure of `params`, for what may be negative."
            )
        flags.append(np.full(jnp.size(p), bool(log)))
    return np.concatenate(flags)


def _deviations(sigma: PyTree, data: PyTree) -> PyTree:
    """One for each datum."""
    given = _numbers("sigma", _spread("sigma", sigma, data, "numbers"))

    def spread(path: tuple[Any, ...], s: Array, d: Array) -> Array:
        if not isinstance(s, Tracer) and not np.all(np.asarray(s) > 0):
            raise ValueError(f"{_at('sigma', path)} must be positive, but holds {np.min(s):g}.")
        if s.ndim > d.ndim or not all(k in (1, n) for k, n in zip(s.shape[::-1], d.shape[::-1], strict=False)):
            raise ValueError(f"{_at('sigma', path)} must go with data of the shape {d.shape}, but has {s.shape}.")
        return jnp.broadcast_to(s, d.shape)

    return jax.tree_util.tree_map_with_path(spread, given, data)


def _spread(what: str, prefix: PyTree, tree: PyTree, kind: str) -> PyTree:
    try:
        return jax.tree.broadcast(prefix, tree)
    except ValueError as error:
        raise ValueError(f"`{what}` must hold {kind} in the structure of {describe(tree)}, but is {prefix}.") from error


def _refuse_another_shape(given: PyTree, data: PyTree) -> None:
    shapes = lambda tree: (jax.tree.structure(tree), [jnp.shape(x) for x in jax.tree.leaves(tree)])
    if shapes(given) != shapes(data):
        raise ValueError(f"`model` must return what `data` is, {describe(data)}, but returns {describe(given)}.")


def _refuse_fewer_digits(given: PyTree, dtype: DType) -> None:
    for leaf in jax.tree.leaves(given):
        kind = jnp.result_type(leaf)
        if jnp.issubdtype(kind, jnp.complexfloating):
            raise TypeError(f"`model` must return real numbers, but returns {describe(given)}.")
        # Which combinations do not show is told from the digits of J.
        if jnp.issubdtype(kind, jnp.floating) and jnp.finfo(kind).bits < jnp.finfo(dtype).bits:
            raise TypeError(
                f"`model` must have the digits of `params`, {dtype}, but returns {describe(given)}: pass `params` in {kind}."
            )


def _refuse_too_few(params: PyTree, data: PyTree, estimated: bool) -> None:
    p, m = (sum(jnp.size(x) for x in jax.tree.leaves(tree)) for tree in (params, data))
    if estimated and m <= p:
        raise ValueError(
            f"There must be more data than parameters for the noise to be estimated, but there are {m} and {p}: pass `sigma`."
        )


# What comes of it


def _refuse_failure(model: Callable[[Any], Any], params: PyTree, found: Identified, failed: Failed, steps: int) -> None:
    if not (failed.unfinished or failed.peaked):
        return
    # A function of its own, as what `model` reads from around it may have changed since JAX has seen it.
    first = jax.jit(lambda params: model(params))(params)
    for path, leaf in jax.tree_util.tree_leaves_with_path(first):
        _refuse_not_finite("model", path, leaf, AT_THE_START)
    if not np.isfinite(found.cost) or not np.all(np.isfinite(found.information)):
        raise ValueError("The derivative of `model` is not finite at the start, `params`.")
    if not failed.unfinished:
        raise RuntimeError(
            f"`identify` has come to a maximum of the squares of the residuals, or to a saddle: it is at {found!r}, where they fall to "
            "a side. Start elsewhere by `params`."
        )
    raise RuntimeError(
        f"`identify` has not come to the minimum in {int(found.iterations)} of {steps} steps: it is at {found!r}, and that of the linear "
        f"model is {found.offset:.2g} standard errors away. {_advice(params, found)}"
    )


def _advice(params: PyTree, found: Identified) -> str:
    """Against what keeps a descent from its end."""
    start, end, log = (np.asarray(ravel_pytree(tree)[0]) for tree in (params, found.params, found.in_log))
    lost = [
        name
        for name, *pair, is_log in zip(found.names, start, end, log, strict=True)
        if is_log and pair[1] < LOST * pair[0]
    ]
    if lost:
        return (
            f"{', '.join(lost)} has gone to 0, as where the data are met best by one that is not positive: leave it out, or "
            "seek it with `positive=False`."
        )
    return "Start nearer by `params`, allow more `steps`, or solve by tighter tolerances where the model is rough at that of its solve."


def _warn(found: Identified) -> None:
    for doubt in found.doubts:
        warnings.warn(doubt, AccuracyWarning, stacklevel=3)
