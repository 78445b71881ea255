"""The example that has JAX differentiate answers; skipped where JAX is not installed."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import stiffopt as so

jax = pytest.importorskip("jax", reason="JAX is not installed, which only an example needs")

EXAMPLE = Path(__file__).parents[1] / "examples" / "jax_layer.py"


def test_jax_differentiates_answers(compiled):
    robot, place = so.load_robot("stiff-flop-2"), np.array([-0.03, 0.01, 0.19])
    goal = so.StiffnessGoal(maximise=[so.StiffnessMeasure(direction=(1, 0, 0))])
    task = so.Task(target=so.Target(position=tuple(place)), stiffness=goal)
    answer = runpy.run_path(str(EXAMPLE))["stiffest"](robot, task)
    found = so.solve_pressure(robot, task)
    pressures, stiffness = jax.jit(answer)(place)
    np.testing.assert_allclose(pressures, found.pressures)
    assert stiffness == pytest.approx(found.stiffness)
    slope = jax.grad(lambda x: answer(x)[1])(place)
    np.testing.assert_allclose(slope, found.gradient("stiffness", by="target"))
    jacobian = jax.jacrev(lambda x: answer(x)[0])(place)
    np.testing.assert_allclose(jacobian, found.gradient("pressures", by="target"))
    _, stiffnesses = jax.vmap(answer)(np.stack([place, place + 1e-4]))
    assert stiffnesses[0] == pytest.approx(found.stiffness)
