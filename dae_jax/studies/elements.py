"""What a sweep goes over: arrays of numbers and of keys with a common leading axis."""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import PyTree

from ..validate.states import brief


def one_of(elements: PyTree) -> PyTree:
    """The shapes of one element."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], jax.dtypes.canonicalize_dtype(x.dtype)), elements)


@dataclasses.dataclass(frozen=True)
class OfKeys:
    """`fn` of elements whose keys of `jax.random.key`, the leaves that have one of `kinds`, are numbers."""

    fn: Callable[..., PyTree]
    kinds: tuple[str | None, ...]

    @classmethod
    def of(cls, fn: Callable[..., PyTree], elements: PyTree) -> tuple["OfKeys", PyTree]:
        """The function, and the elements as numbers."""
        leaves, structure = jax.tree.flatten(elements)
        kinds = tuple(str(jax.random.key_impl(x)) if is_key(x) else None for x in leaves)
        numbers = [jax.random.key_data(x) if is_key(x) else x for x in leaves]
        return cls(fn, kinds), jax.tree.unflatten(structure, numbers)

    def __call__(self, element: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(element)
        keyed = [
            x if k is None else jax.random.wrap_key_data(x, impl=k) for x, k in zip(leaves, self.kinds, strict=True)
        ]
        return self.fn(jax.tree.unflatten(structure, keyed))


def is_key(x: object) -> bool:
    """Whether it is an array of keys of `jax.random.key`."""
    return isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def leading(elements: PyTree) -> int:
    """How many elements there are.

    Errors: `TypeError` for what is no number, `ValueError` for whole numbers of more bits than JAX computes with, and for arrays
    without a common leading axis.
    """
    wrong = [x for x in jax.tree.leaves(elements) if not (jax.dtypes.issubdtype(x.dtype, np.number) or x.dtype == bool)]
    if wrong:
        raise TypeError(f"`inputs` must be arrays of numbers, but holds {brief(wrong[0])}.")
    for x in jax.tree.leaves(elements):
        kind = jax.dtypes.canonicalize_dtype(x.dtype)
        if jax.dtypes.issubdtype(kind, np.integer) and (x.astype(kind) != x).any():
            raise ValueError(
                f"`inputs` hold whole numbers that {kind} does not: switch on 64 bits, `jax.config.update('jax_enable_x64', True)`."
            )
    shapes = [x.shape for x in jax.tree.leaves(elements)]
    sizes = {s[0] if s else None for s in shapes}
    if len(sizes) != 1 or None in sizes or 0 in sizes:
        raise ValueError(
            f"`inputs` must be arrays with a common leading axis that is not empty, but have the shapes {shapes}."
        )
    return shapes[0][0]
