"""The stiffest pressures as a function that JAX differentiates, forwards and backwards."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import stiffopt

jax.config.update("jax_enable_x64", True)


def stiffest(robot: stiffopt.Manipulator, task: stiffopt.Task) -> Callable[[Any], Any]:
    """Function from the target's position (3,) in m to pressures (n,) in Pa and their stiffness."""
    solver = stiffopt.PressureSolver(robot, task)

    def solved(position: Any) -> stiffopt.PressureSolution:
        place = tuple(np.asarray(position, dtype=float).tolist())
        found = solver.solve(task.target.model_copy(update={"position": place}))
        if not found.found:
            raise ValueError(found.message)
        return found

    def values(position: Any) -> Any:
        found = solved(position)
        return np.asarray(found.pressures), np.asarray(found.stiffness)

    def slopes(position: Any) -> Any:
        found = solved(position)
        return tuple(found.gradient(of, by="target")[..., :3] for of in ("pressures", "stiffness"))

    def called(function: Any, *shapes: Any) -> Any:
        kinds = tuple(jax.ShapeDtypeStruct(shape, float) for shape in shapes)
        return lambda x: jax.pure_callback(function, kinds, x, vmap_method="sequential")

    n = robot.n_pressures
    answer = jax.custom_jvp(called(values, (n,), ()))
    slopes_at = called(slopes, (n, 3), (3,))

    @answer.defjvp
    def _answer_and_change(primals: Any, tangents: Any) -> Any:
        return answer(*primals), tuple(slope @ tangents[0] for slope in slopes_at(*primals))

    return answer


if __name__ == "__main__":
    arm = stiffopt.load_robot("stiff-flop-2")
    goal = stiffopt.StiffnessGoal(maximise=[stiffopt.StiffnessMeasure(direction=(1, 0, 0))])
    target = stiffopt.Target(position=(-0.03, 0.01, 0.19))
    answer = stiffest(arm, stiffopt.Task(target=target, stiffness=goal))
    softening = jax.jit(jax.grad(lambda position: answer(position)[1]))
    print("N/m per m:", softening(np.array(target.position)))
