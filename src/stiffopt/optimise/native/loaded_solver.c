/* The solver of solver.c for an arm under gravity or loads. */
#define STIFFOPT_LOADED
#include "solver.c"

/* Evaluate a task's program at pressures (n), from rest: all values of a point in order, with rows
 * of obstacles zero.  Return 0 without an equilibrium. */
int stiffopt_point(const Setup *setup, const double *parameters, const double *radii,
                   const double *pressures, double *values) {
    const double *arg[WORK_ARG];
    double *res[WORK_RES], w[WORK_W + 1];
    casadi_int iw[WORK_IW + 1];
    Program program = {.setup = setup, .arg = arg, .res = res, .iw = iw, .w = w};
    program.parameters = parameters, program.radius = radii, program.sight = KNOWN;
    if (!add_memory(&program)) return 0;
    NEW_POINT(p, setup);
    for (int64_t i = 0; i < setup->n; i++) p.x[i] = pressures[i] / setup->unit[i];
    memset(p.r, 0, (size_t)setup->rows * sizeof(double));
    memset(p.J, 0, (size_t)(setup->rows * setup->n) * sizeof(double));
    forget_state(setup, &p);
    int good = evaluate(&program, &p, 1);
    memcpy(values, p.x, (size_t)value_count(setup) * sizeof(double));
    free_memory(&program);
    return good;
}
