"""The mutation study: its mutants are valid programs that differ from the module by one expression."""

import ast

from studies import study as import_study

study = import_study("stability/mutation_study")

SOURCE = '''"""One 1."""
def f(x: Float[Array, "1"], n=2) -> int:
    """Two 2."""
    if n < 1:
        raise ValueError(f"{n - 1}" + "3")
    return jnp.where(x > 0, jax.lax.stop_gradient(x), -x) + jnp.expm1(x)
'''


def test_each_mutant_changes_one_expression_that_runs():
    mutants = study.mutants_of("encoding", SOURCE)
    changes = {(mutant.line, mutant.before, mutant.after) for mutant in mutants}
    assert {
        (2, "2", "3"),
        (4, "n < 1", "n <= 1"),
        (4, "1", "2"),
        (6, "x > 0", "x >= 0"),
        (6, "jax.lax.stop_gradient(x)", "x"),
        (6, "-x", "x"),
        (6, "jnp.expm1(x)", "jnp.exp(x) - 1"),
    } < changes and {line for line, _, _ in changes} == {2, 4, 6}
    for mutant in mutants:
        assert ast.dump(ast.parse(mutant.source)) != ast.dump(ast.parse(SOURCE))


def test_each_module_of_core_has_tests():
    for path in (study.ROOT / study.CORE).rglob("[!_]*.py"):
        module = path.relative_to(study.ROOT / study.CORE).with_suffix("").as_posix()
        assert all((study.ROOT / test).is_file() for test in study.tests_of(module)), module
