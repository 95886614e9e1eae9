"""Solves with every shape and type of the equations and of the linear algebra checked, as their annotations say."""

import jax
from jaxtyping import install_import_hook

import tests.typechecker  # noqa: F401  # the hook looks it up


jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")


def main() -> None:
    with install_import_hook(["dae_jax.equations", "dae_jax.linalg"], "tests.typechecker.checked"):
        import dae_jax
    from dae_jax import scenes

    cases = [
        (scenes.pendulum(), dae_jax.OrthogonalProjection(dae_jax.DOP853()), None, None),
        (scenes.pendulum(), dae_jax.RATTLE(), None, 0.01),
        (scenes.pendulum(), dae_jax.DOP853(), dae_jax.DummyDerivatives(), None),
        (scenes.chain(6), dae_jax.TangentSpace(dae_jax.DOP853()), None, None),
        (scenes.four_bar(redundant=True), dae_jax.OrthogonalProjection(dae_jax.DOP853()), None, None),
        (scenes.knife_edge(), dae_jax.DOP853(), dae_jax.Baumgarte(10.0, 10.0), None),
        (scenes.jay(), dae_jax.OrthogonalProjection(dae_jax.DOP853()), None, None),
        (scenes.capacitor_loop(), dae_jax.RadauIIA5(), None, None),
        (scenes.car_axis(), dae_jax.BDF(), dae_jax.GGL(), None),
        (scenes.chain(9), dae_jax.RadauIIA5(), None, None),
    ]
    for scene, solver, formulation, step in cases:
        sol = dae_jax.daesolve(
            scene.system, solver, 0.0, 0.05, step, scene.y0, scene.args, formulation=formulation, throw=False
        )
        assert sol.result == dae_jax.RESULTS.successful, (scene.name, type(solver).__name__)
    print(len(cases), "solves checked")


if __name__ == "__main__":
    main()
