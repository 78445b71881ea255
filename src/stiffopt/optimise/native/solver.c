/* Compiled solver: solve tasks of one structure on one arm, given as rows of numbers.
 *
 * The row of a task has the parameters of its functions, radii of the balls, lower and upper
 * pressure limits (Pa), floors, the `Nearness` of each term, the request and a guess (Pa).
 * For the row of an answer see `solve_row`.
 */
#include "functions.h"

#include "closest.h"

#ifndef STIFFOPT_LOADED
void point_rows(void); /* marks the end of the code of `point` */
#endif

#define CACHE_LINE 64    /* bytes */
#define MOST_CODE 400000 /* bytes */

/* Requests and outcomes, as in fast.py. */
enum { SEARCH, GUESS_FIRST, GUESS_ALONE, JUDGE, REACH_ONLY, CLOSEST, CLOSEST_FROM, BROUGHT };
enum { NEEDS_GENERAL_METHOD, LOCAL, GLOBAL, JUDGED, REACHED, NEAREST, NOT_FINITE, TOO_SOFT };

/* Start a point at a guess (n) in Pa. */
static void start_at(Program *P, const double *guess, Point *p) {
    const Setup *s = P->setup;
    for (int64_t i = 0; i < s->n; i++)
        p->x[i] = clip(guess[i] / s->unit[i], P->lower[i], P->upper[i]);
    forget_state(s, p);
}

/* Bring a guess (n) in Pa to the target; 0 if that fails or ends where the body is not clear. */
static int brought(Program *P, const double *guess, Point *p) {
    start_at(P, guess, p);
    return reach_blindly(P, p, P->setup->reach.iterations) && evaluate(P, p, 1) && p->reached;
}

/* Descend from a guess (n) in Pa; return whether the end meets the floors and is an optimum, or was
 * stopped. */
static int from_guess(Program *P, const double *guess, Point *p, Descent *end, Found *found) {
    const Setup *s = P->setup;
    start_at(P, guess, p);
    if (!reach(P, p, s->reach.iterations) || !evaluate(P, p, 1)) return 0;
    *end = descend(P, p, NULL);
    *found = (Found){1, 1, 1, 1, 1, 0, end->iterations};
    return (end->converged || stopped(P)) && end->violation < 0.5 * s->descent.floor_margin;
}

/* Solve one row.
 *
 * The answer's row has: outcome, value, violation, converged, the seven numbers of Found, three
 * counts of evaluations, pressures (n) in Pa, for the closest configuration the slope (n) of its
 * error per unit of x, then the output of judge_at.  The answer to GUESS_ALONE is judged only among
 * obstacles; otherwise the caller judges it when needed.
 */
static void solve_row(Program *P, const double *task, double *answer) {
    const Setup *s = P->setup;
    P->parameters = task, task += s->parameters;
    P->radius = task, task += s->balls;
    const double *low = task, *high = task + s->n;
    double lower[s->n], upper[s->n];
    for (int64_t i = 0; i < s->n; i++) lower[i] = low[i] / s->unit[i], upper[i] = high[i] / s->unit[i];
    P->lower = lower, P->upper = upper, task += 2 * s->n;
    P->floor = task, task += s->floors;
    P->near = task, task += 18 * s->near;
    int64_t mode = (int64_t)*task++, outcome = NEEDS_GENERAL_METHOD;
    P->poses = P->points = P->programs = 0;
    P->sight = NEAR;

    NEW_POINT(p, s);
    Descent end = {0, 0, 0, 0};
    Found found = {0, 0, 0, 0, 0, 0, 0};
    double slope[s->n];
    memset(slope, 0, sizeof slope);
    if (!all_finite(P->parameters, s->parameters) || !all_finite(task, s->n))
        outcome = NOT_FINITE;
    else if (mode == JUDGE)
        outcome = JUDGED;
    else if (mode == REACH_ONLY)
        outcome = can_reach(P, &p, s->least_effort.screened) ? REACHED : NEEDS_GENERAL_METHOD;
    else if (mode == CLOSEST || mode == CLOSEST_FROM)
        outcome = closest(P, mode == CLOSEST ? NULL : task, p.x, slope, &found)
            ? NEAREST : NEEDS_GENERAL_METHOD;
    else if (mode == BROUGHT)
        outcome = brought(P, task, &p) ? REACHED : NEEDS_GENERAL_METHOD, end.value = objective(s, &p);
    else if (mode != SEARCH && from_guess(P, task, &p, &end, &found))
        outcome = LOCAL;
    else if (mode != GUESS_ALONE && search(P, &p, &end, &found))
        outcome = end.violation < 0.5 * s->descent.floor_margin ? GLOBAL : TOO_SOFT;
    double *out = answer;
    *out++ = (double)outcome, *out++ = end.value, *out++ = end.violation, *out++ = end.converged;
    *out++ = (double)found.tried, *out++ = (double)found.reached, *out++ = (double)found.descents;
    *out++ = (double)found.agreeing, *out++ = (double)found.optima;
    *out++ = (double)found.complete, *out++ = (double)found.iterations;
    *out++ = (double)P->poses, *out++ = (double)P->points, *out++ = (double)P->programs;
    double *pressures = out;
    for (int64_t i = 0; i < s->n; i++)
        *out++ = outcome == JUDGED ? task[i] : clip(p.x[i] * s->unit[i], low[i], high[i]);
    memcpy(out, slope, sizeof slope), out += s->n;
    int judged = outcome == GLOBAL || outcome == NEAREST || outcome == JUDGED || outcome == TOO_SOFT ||
                 (outcome == LOCAL && (mode != GUESS_ALONE || P->around));
    if (judged && !judge_at(P, pressures, out)) answer[0] = NEEDS_GENERAL_METHOD;
}

/* Prefetch machine code, many cache lines at once.  Without this, a processor whose caches have
 * lost the code waits for each line in turn.  This relies on functions being linked in the order of
 * their files; in another order it is useless but harmless. */
static void fetch(uintptr_t begin, uintptr_t end) {
    for (uintptr_t at = begin; at < end && at < begin + MOST_CODE; at += CACHE_LINE)
        __builtin_prefetch((const void *)at, 0, 2);
    __asm__ volatile(""); /* keep the compiler from removing a function without effects */
}

/* Size of a Setup, for the caller to check that it has the same fields. */
int64_t stiffopt_setup_size(void) { return sizeof(Setup); }

/* Solve tasks begin to end - 1 of rows of the given widths; return nonzero if out of memory. */
int stiffopt_solve(const Setup *setup, const double *tasks, int64_t task_width, double *answers,
                   int64_t answer_width, int64_t begin, int64_t end, const Stop *stop) {
    const double *arg[WORK_ARG];
    double *res[WORK_RES], w[WORK_W + 1];
    casadi_int iw[WORK_IW + 1];
    Program program = {.setup = setup, .arg = arg, .res = res, .iw = iw, .w = w};
    program.stop = stop, program.deadline = stop ? now() + stop->seconds : 0;
    if (!add_memory(&program)) return 1;
#ifndef STIFFOPT_LOADED
    fetch((uintptr_t)&pose, (uintptr_t)&point_rows); /* the model */
    fetch((uintptr_t)&dot, (uintptr_t)&stiffopt_solve);
#endif
    for (int64_t i = begin; i < end; i++)
        solve_row(&program, tasks + i * task_width, answers + i * answer_width);
    free_memory(&program);
    return 0;
}

/* A single task; mirrors `_OneTask` in fast.py. */
typedef struct {
    const Setup *setup;
    const double *task;
    double *answer;
    const Stop *stop;
} OneTask;

/* Solve it; return the outcome, -1 if out of memory. */
int stiffopt_solve_one(const OneTask *one) {
    if (stiffopt_solve(one->setup, one->task, 0, one->answer, 0, 0, 1, one->stop)) return -1;
    return (int)one->answer[0];
}
