/* Tasks of one structure on one arm, solved row by row.
 *
 * A task is a row of numbers: parameters of its functions, radii of the balls, lower and upper
 * pressure limits (Pa), floors, the `Nearness` of each term, a flag and a guess (Pa).
 * An answer is a row of numbers too, see `solve_row`.
 */
#include "functions.h"

#include "search.h"

enum { NEEDS_GENERAL_METHOD, LOCAL, GLOBAL };

/* Row of an answer: outcome, value, violation, converged, the seven numbers of Found, three
 * counts of evaluations, pressures (n) in Pa, then what judge_at writes.
 */
static void solve_row(Program *P, const double *task, double *answer) {
    const Setup *s = P->setup;
    P->parameters = task, task += s->parameters;
    P->radius = task, task += s->balls;
    const double *least = task, *most = task + s->n;
    double lower[s->n], upper[s->n];
    for (int64_t i = 0; i < s->n; i++) lower[i] = least[i] / s->unit[i], upper[i] = most[i] / s->unit[i];
    P->lower = lower, P->upper = upper, task += 2 * s->n;
    P->floor = task, task += s->floors;
    P->near = task, task += 18 * s->near;
    int guessed = *task++ != 0;
    P->poses = P->points = P->programs = 0;

    NEW_POINT(p, s);
    Descent end = {0, 0, 0, 0};
    Found found = {0, 0, 0, 0, 0, 0, 0};
    int64_t outcome = NEEDS_GENERAL_METHOD;
    if (guessed) {
        for (int64_t i = 0; i < s->n; i++) p.x[i] = clip(task[i] / s->unit[i], lower[i], upper[i]);
        forget_state(s, &p);
        if (reach(P, &p, s->reach.iterations) && evaluate(P, &p, 1)) {
            end = descend(P, &p, NULL);
            found = (Found){1, 1, 1, 1, 1, 0, end.iterations};
            if (end.converged && end.violation < 0.5 * s->descent.floor_margin) outcome = LOCAL;
        }
    }
    if (outcome != LOCAL && search(P, &p, &end, &found) && end.violation < 0.5 * s->descent.floor_margin)
        outcome = GLOBAL;
    double *out = answer;
    *out++ = (double)outcome, *out++ = end.value, *out++ = end.violation, *out++ = end.converged;
    *out++ = (double)found.tried, *out++ = (double)found.reached, *out++ = (double)found.descents;
    *out++ = (double)found.agreeing, *out++ = (double)found.optima;
    *out++ = (double)found.complete, *out++ = (double)found.iterations;
    *out++ = (double)P->poses, *out++ = (double)P->points, *out++ = (double)P->programs;
    double *pressures = out;
    for (int64_t i = 0; i < s->n; i++)
        *out++ = clip(p.x[i] * s->unit[i], least[i], most[i]);
    if (outcome != NEEDS_GENERAL_METHOD && !judge_at(P, pressures, out))
        answer[0] = NEEDS_GENERAL_METHOD;
}

/* For the caller to check that it has the same idea of a Setup. */
int64_t stiffopt_setup_size(void) { return sizeof(Setup); }

/* Solve tasks begin to end - 1 of rows of the given widths; not 0 if memory is short. */
int stiffopt_solve(const Setup *setup, const double *tasks, int64_t task_width, double *answers,
                   int64_t answer_width, int64_t begin, int64_t end) {
    const double *arg[WORK_ARG];
    double *res[WORK_RES], w[WORK_W + 1];
    casadi_int iw[WORK_IW + 1];
    Program program = {.setup = setup, .arg = arg, .res = res, .iw = iw, .w = w};
    if (!add_memory(&program)) return 1;
    for (int64_t i = begin; i < end; i++)
        solve_row(&program, tasks + i * task_width, answers + i * answer_width);
    free_memory(&program);
    return 0;
}
