"""Pytrees of arrays as flat vectors."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree


@dataclasses.dataclass(frozen=True)
class Layout:
    """How a pytree of arrays lies in a flat vector. Hashable, so that it can be static under `jit`."""

    treedef: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, tree: PyTree) -> "Layout":
        """The layout of `tree`."""
        leaves, treedef = jax.tree.flatten(tree)
        return cls(treedef, tuple(jnp.shape(leaf) for leaf in leaves))

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of entries of each leaf."""
        return tuple(math.prod(shape) for shape in self.shapes)

    @property
    def size(self) -> int:
        """The number of entries in all."""
        return sum(self.sizes)

    def names(self) -> tuple[str, ...]:
        """A name for each entry: its path in the pytree and its index, such as `['arm'][2]`."""
        paths, _ = jax.tree_util.tree_flatten_with_path(jax.tree.unflatten(self.treedef, self.shapes_as_leaves()))
        names: list[str] = []
        for (path, _), shape in zip(paths, self.shapes, strict=True):
            stem = jax.tree_util.keystr(path)
            for flat in range(math.prod(shape)):
                index, rest = [], flat
                for extent in reversed(shape):
                    index.append(rest % extent)
                    rest //= extent
                names.append(stem + (f"[{', '.join(map(str, reversed(index)))}]" if shape else ""))
        return tuple(names)

    def shapes_as_leaves(self) -> list[int]:
        """One number a leaf, to rebuild the pytree with."""
        return list(self.sizes)

    def flatten(self, tree: PyTree) -> Float[Array, " n"]:
        """The entries of `tree` as one vector; a single vector is handed back as it is."""
        leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
        if len(leaves) == 1:
            return leaves[0].reshape(-1) if leaves[0].ndim != 1 else leaves[0]
        return jnp.concatenate([leaf.reshape(-1) for leaf in leaves]) if leaves else jnp.zeros(0)

    def unflatten(self, vector: Float[Array, " n"]) -> Any:
        """The pytree whose entries are those of `vector`."""
        leaves, start = [], 0
        for shape, size in zip(self.shapes, self.sizes, strict=True):
            piece = vector if size == vector.shape[0] else vector[start : start + size]
            leaves.append(piece if piece.shape == shape else piece.reshape(shape))
            start += size
        return jax.tree.unflatten(self.treedef, leaves)
