"""What the user's functions take and return, looked at without numbers: wrong ones are refused in a sentence."""

import contextlib
import functools
import inspect
import types
from collections.abc import Callable, Hashable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from ..compiler import equations
from ..systems import ConstrainedSystem, System, is_mechanism
from ..types import Args, State, Time
from .around import of_library
from .captured import REMEMBERED, Captured
from .states import NUMBERS, describe


TRACED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
LEADING_AXIS = (
    "`y0` must be one state, but has a leading axis of length {}: a time axis as in `sol.ys`, or a batch. Go on from the last "
    "saved state with `y0=sol.final`, that is `jax.tree.map(lambda x: x[-1], sol.ys)`; solve a batch with `jax.vmap`."
)


P = ParamSpec("P")
T = TypeVar("T")


def at_numbers(fn: Callable[P, T]) -> Callable[P, T]:
    """A function that looks at the numbers it is given, or that the user's functions close over; what traces them is refused."""

    @functools.wraps(fn)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return fn(*args, **kwargs)
        except TRACED as error:
            raise ValueError(
                f"`{fn.__name__}` looks at numbers, which are not known within `jit`, `vmap` and `grad`: call it outside of them."
            ) from error

    return checked


@contextlib.contextmanager
def refuse_untraceable(name: str) -> Iterator[None]:
    """Around the tracing of the user's function of this name, which may make numbers of what it is given."""
    try:
        yield
    except TRACED as error:
        raise ValueError(
            f"`{name}` must be traceable by JAX, but makes numbers of what it is given ({_first_line(error)}): use jax.numpy "
            "and `jnp.where` in place of numpy, `math`, `float` and `if`, and return arrays."
        ) from error


# The last functions that have been seen to have the same numbers in them each time they are called, by their keys.
_settled: dict[Hashable, None] = {}


def refuse_wrong_functions(system: System, t: Time, state: State, args: Args) -> None:
    """Refuses functions of a system that cannot be called with (t, state, args), or return what does not fit the state.

    Errors: `ValueError` in a sentence with the function's name, what it must return, what it returned, and what to do.
    """
    try:
        _refuse(system, t, state, args)
    except ValueError as refusal:
        advice = time_axis_advice(system, t, state, args)
        is_row = lambda x: type(x) is list or (type(x) is tuple and x is not state and all(map(_is_number, x)))
        row = next(filter(is_row, jax.tree.leaves(state, is_leaf=is_row)), None)
        if not advice and row is not None:
            named = "lists" if type(row) is list else "tuples of numbers"
            advice = f"`y0` holds {named}, which are no arrays: write jnp.array([1.0, 0.0]) in place of {type(row)((1.0, 0.0))}."
        if advice:
            raise ValueError(f"{advice}\n({refusal})") from refusal
        raise


def _is_number(x: object) -> bool:
    return isinstance(x, NUMBERS) and not np.shape(x)


def time_axis_advice(system: System, t: Time, state: State, args: Args) -> str:
    """What to say of a state whose leading axis seems to be one of times or of a batch; "" of others."""
    shapes = [jnp.shape(x) for x in jax.tree.leaves(state)]
    if not all(shapes) or len({s[0] for s in shapes}) != 1:
        return ""
    fits = lambda state: _fits(system, t, state, args)
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x)[1:], jnp.result_type(x)), state)
    # Functions that work number by number take vectors and numbers alike: the vectors are meant.
    if not fits(one) or (all(len(s) == 1 for s in shapes) and fits(state)):
        return ""
    return LEADING_AXIS.format(shapes[0][0])


def _fits(system: System, t: Time, state: State, args: Args) -> bool:
    try:
        _refuse(system, t, state, args)
    except ValueError:
        return False
    return True


def _refuse(system: System, t: Time, state: State, args: Args) -> None:
    for call in system.calls(t, state, args):
        found = returned(call.signature, call.function, *call.values)
        if call.returns == "structure":
            _like(found, call.signature, call.like, call.of)
        elif call.returns == "count":
            _as_many(found, call.signature, call.like, call.of)
        else:
            _is_vector(found, call.signature)
    if is_mechanism(system):
        _check_mass(system, state[0], args)


def returned(call: str, function: Callable[..., Any], *values: State) -> Any:
    """The shapes that `function` returns for these arguments; `call` is how it is to be called, `force(t, q, v, args)`."""
    refuse_other_arguments(call, function, len(values))
    try:
        if _is_settled(function):
            return eqx.filter_eval_shape(function, *values)
        jaxpr, arrays, others = eqx.filter_make_jaxpr(function)(*values)
        again, *_ = eqx.filter_make_jaxpr(function)(*values)
    except TRACED as error:
        raise ValueError(
            f"`{call}` must be traceable by JAX, but makes numbers of its arguments ({_first_line(error)}): use jax.numpy and "
            "`jnp.where` in place of numpy, `math`, `float` and `if`."
        ) from error
    except Exception as error:
        left_out = call.endswith("args)") and values[-1] is None and "NoneType" in str(error)
        raise ValueError(
            f"`{call}` fails with {', '.join(_named(call, values))}: {type(error).__name__}: {_first_line(error)}."
            f"{' No `args` were given: pass `args=...`.' if left_out else ''}"
        ) from error
    if _numbers_in(jaxpr) != _numbers_in(again):
        raise ValueError(
            f"`{call}` has other numbers in it each time it is called, such as random ones or the time of day: the compiled program would "
            "go on with those of one call. Find them before, and hand them over in `args`."
        )
    if isinstance(function, Captured):
        _settled[function.key] = None
        for oldest in list(_settled)[:-REMEMBERED]:
            _settled.pop(oldest, None)
    return eqx.combine(arrays, others)


def _is_settled(function: Callable[..., Any]) -> bool:
    if isinstance(function, Captured):
        return function.key in _settled
    return isinstance(function, types.FunctionType) and of_library(function)


def _numbers_in(jaxpr: jax.extend.core.ClosedJaxpr) -> list[Any]:
    """What a program knows of numbers, but for what is traced outside."""
    found = [x.val for eqn in equations(jaxpr) for x in eqn.invars if isinstance(x, jax.extend.core.Literal)]
    known = (x for x in (*found, *jaxpr.consts) if isinstance(x, NUMBERS) and not isinstance(x, Tracer))
    # Keys of `jax.random` are of no dtype of numpy, and made of numbers that are there too.
    return [np.asarray(x).tobytes() for x in known if isinstance(getattr(x, "dtype", np.dtype(float)), np.dtype)]


def refuse_other_arguments(call: str, function: Callable[..., Any], count: int, **keywords: object) -> None:
    """Refuses functions that cannot be called as `call` says, with `count` arguments and keyword arguments."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(*range(count), **keywords)
    except TypeError:
        raise ValueError(
            f"`{call}` must take these arguments, but the function given takes {signature}: write `def {call}: ...`."
        ) from None


def _named(call: str, values: Any) -> list[str]:
    names = call.partition("(")[2].rstrip(")").split(", ")
    return [f"{name}: {describe(x)}" for name, x in zip(names, values, strict=False) if name != "t"]


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [""])[0].rstrip(".")


def refuse_no_numbers(found: object, call: str, like: State = None) -> None:
    """Refuses results that are not real floating-point numbers; integers have no derivative, booleans neither."""
    for leaf in _leaves(found, like):
        if not isinstance(leaf, NUMBERS):
            raise ValueError(f"`{call}` must return numbers, but returns {describe(found)}.")
        dtype = jnp.result_type(leaf)
        if not jnp.issubdtype(dtype, jnp.floating):
            raise ValueError(
                f"`{call}` must return real floating-point numbers, which have a derivative, but returns {describe(found)}."
            )


def refuse_no_real_number(found: object, call: str) -> None:
    """Refuses results that are not one real number."""
    if not isinstance(found, NUMBERS) or jnp.shape(found) != () or np.dtype(jnp.result_type(found)).kind not in "fiu":
        raise ValueError(f"`{call}` must return a real number, but returns {describe(found)}.")


def _leaves(found: object, like: State) -> list[Any]:
    """What there should be numbers of; `None` is none of it only where it is one in `like`."""
    same = found is not None and jax.tree.structure(found) == jax.tree.structure(like)
    return jax.tree.leaves(found, is_leaf=None if same else lambda x: x is None)


def _shapes(tree: PyTree) -> tuple[Any, list[Any]]:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [jnp.shape(x) for x in leaves]


def _count(tree: PyTree) -> int:
    return sum(int(np.prod(jnp.shape(x))) for x in jax.tree.leaves(tree))


def _like(found: object, call: str, like: State, name: str) -> None:
    """The structure and the shapes of `like`; for one vector, as many numbers in any other form."""
    # Numbers of other types are cast to those of the state.
    for leaf in _leaves(found, like):
        if not isinstance(leaf, NUMBERS) or jnp.issubdtype(jnp.result_type(leaf), jnp.complexfloating):
            raise ValueError(
                f"`{call}` must return real numbers in the structure of {name}, but returns {describe(found)}."
            )
    is_vector = isinstance(like, NUMBERS) and len(jnp.shape(like)) < 2
    if _shapes(found) != _shapes(like) and not (is_vector and _count(found) == _count(like)):
        raise ValueError(
            f"`{call}` must return the structure of {name}, {describe(like)}, but returns {describe(found)}."
        )


def _as_many(found: object, call: str, like: State, name: str) -> None:
    refuse_no_numbers(found, call, like)
    if _count(found) != _count(like):
        raise ValueError(
            f"`{call}` must return as many equations as {name} has unknowns, {_count(like)}, but returns {_count(found)}: "
            f"{describe(found)}."
        )


def _is_vector(found: object, call: str) -> None:
    if not isinstance(found, NUMBERS):
        raise ValueError(
            f"`{call}` must return a number or a vector, one entry a constraint, but returns {describe(found)}: put the "
            "constraints together with `jnp.stack([...])`, or `jnp.concatenate` for vectors."
        )
    refuse_no_numbers(found, call)
    if _count(found) == 0:
        raise ValueError(
            f"`{call}` must return at least one constraint, but returns {describe(found)}: without constraints it is an ODE, "
            "which `diffrax.diffeqsolve` solves."
        )


def _check_mass(system: ConstrainedSystem, q: State, args: Args) -> None:
    mass, name = system.mass, "mass"
    if callable(mass):
        name = "mass(q, args)"
        mass = returned(name, mass, q, args)
    if mass is None:
        return
    n = _count(q)
    is_array = isinstance(mass, NUMBERS) and (jnp.shape(mass) in ((), (n,), (n, n)) or _is_blocks(jnp.shape(mass), n))
    is_structure = _shapes(mass) in (_shapes(q), _shapes([0.0] * n)) and _all_numbers(mass)
    if not is_array and not is_structure:
        raise ValueError(
            f"`{name}` must be a vector of {n} masses, a ({n}, {n}) matrix, or have the structure of q, {describe(q)}, but is "
            f"{describe(mass)}."
        )


def _is_blocks(shape: tuple[int, ...], n: int) -> bool:
    return len(shape) == 3 and shape[1] == shape[2] and shape[0] * shape[1] == n


def _all_numbers(tree: PyTree) -> bool:
    return all(isinstance(x, NUMBERS) for x in jax.tree.leaves(tree, is_leaf=lambda x: x is None))


def not_finite(system: System, t: Time, state: State, args: Args, when: str = "at the start") -> str:
    """Which of a system's functions are not finite at a state, in a sentence with what may be the reason; "" if all are."""
    # Functions of the solve have seen JAX's arrays.
    state, args = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, (state, args))
    calls = [(call.signature, call.function, call.values) for call in system.calls(t, state, args)]
    if is_mechanism(system) and callable(system.mass):
        calls.append(("mass(q, args)", system.mass, (state[0], args)))
    elif is_mechanism(system):
        calls.append(("mass", lambda: system.mass, ()))
    bad = [call for call, function, values in calls if not _all_finite(function(*values))]
    if not bad:
        return ""
    reason = "; `args` holds NaN or infinity" if not _all_finite(args) else ""
    # What has made the force may know of which part it is.
    parts = getattr(getattr(getattr(system, "force", None), "__self__", None), "not_finite_loads", None)
    reason += "".join(f"; so is {part}" for part in (parts(t, *state, args) if parts else []))
    return f"`{'`, `'.join(bad)}` {'is' if len(bad) == 1 else 'are'} not finite {when}{reason}."


def _all_finite(tree: PyTree) -> bool:
    numbers = [x for x in jax.tree.leaves(tree) if isinstance(x, NUMBERS)]
    return all(bool(jnp.all(jnp.isfinite(jnp.asarray(x)))) for x in numbers)
