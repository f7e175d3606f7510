"""The types of arrays inside jax.shard_map, which tell over which axes of the mesh an array may vary.

The carry of a loop must have one type. What begins as constants, equal on all devices, does not have the type of what
the loop computes from sharded arrays.
"""

from typing import TypeVar

import jax

_Tree = TypeVar("_Tree")


def vary_like(tree: _Tree, *others: object) -> _Tree:
    """Marks arrays as varying over all mesh axes over which others vary; outside jax.shard_map nothing changes.

    Args:
        tree: of arrays.
        *others: trees of arrays or of jax.ShapeDtypeStruct, such as the result of jax.eval_shape.

    Returns:
        The tree, with the same values.
    """
    axes = frozenset().union(*(_axes(leaf) for leaf in jax.tree.leaves(others)))

    def mark(leaf):
        missing = tuple(sorted(axes - _axes(leaf)))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(mark, tree)


def _axes(leaf):
    kind = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    manual = getattr(kind, "manual_axis_type", None)
    return getattr(manual or kind, "varying" if manual else "vma", None) or frozenset()  # vma: JAX 0.10.0
