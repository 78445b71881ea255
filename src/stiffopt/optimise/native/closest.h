/* Find the configuration closest to the target, by the method of diagnosis.py.
 *
 * Terms of the target are approached in stages.  Each stage keeps the terms of those before within
 * their tolerances or, if these cannot be met, at their least errors.
 */
#ifndef STIFFOPT_CLOSEST_H
#define STIFFOPT_CLOSEST_H

#include "search.h"

#define FREE 1e6 /* radius of the terms of later stages */

/* Set p to a start of a stage: first the best of the stage before, then alternately a sample near
 * the target and an arbitrary one.  Return 0 when there are no more. */
static int closest_start(Program *P, int64_t number, const double *last, const Ranked *nearest,
                         int64_t count, Point *p) {
    const Setup *s = P->setup;
    if (last && number-- == 0) {
        memcpy(p->x, last, (size_t)s->n * sizeof(double));
        forget_state(s, p);
        return 1;
    }
    if (number / 2 >= s->closest.samples || number / 2 >= count) return 0;
    start_from_sample(P, number % 2 ? number / 2 : nearest[number / 2].index, p);
    return 1;
}

/* Find the optima x (known->count, n) of a stage, from the start `last` and samples. */
static void closest_optima(Program *P, const double *last, const Ranked *nearest, int64_t count,
                           const ClosestSettings *set, Known *known, Found *found) {
    const Setup *s = P->setup;
    int64_t nothing_new = 0, descents = 0;
    NEW_POINT(p, s);
    for (int64_t i = 0; closest_start(P, i, last, nearest, count, &p); i++) {
        if (stopped(P) || descents >= set->compiled_descents) break;
        if (nothing_new >= set->compiled_agreeing) break;
        found->tried++;
        if (!reach(P, &p, s->reach.iterations) || !evaluate(P, &p, 1)) continue;
        Descent now = descend(P, &p, known);
        found->iterations += now.iterations, found->descents++, descents++;
        if (!isfinite(now.value)) continue;
        int is_new = 1;
        for (int64_t k = 0; k < known->count; k++) is_new = is_new && !same(s, &now, known->ends + k);
        nothing_new = is_new ? 0 : nothing_new + 1;
        if (!is_new) continue;
        int64_t k = known->count++; /* insert in order, the best first */
        for (; k > 0 && known->ends[k - 1].value > now.value; k--) {
            known->ends[k] = known->ends[k - 1];
            memcpy(known->x + k * s->n, known->x + (k - 1) * s->n, (size_t)s->n * sizeof(double));
        }
        known->ends[k] = now;
        memcpy(known->x + k * s->n, p.x, (size_t)s->n * sizeof(double));
    }
}

/* Evaluate pressures from rest, as p; return 0 without an equilibrium. */
static int evaluate_from_rest(Program *P, const double *x, Point *p) {
    memcpy(p->x, x, (size_t)P->setup->n * sizeof(double));
    forget_state(P->setup, p);
    return evaluate(P, p, 1);
}

/* Find the pressures x (n) nearest to the target, and the Lagrangian's gradient there.  Return 0 if
 * none are found, or are not confirmed from rest.  A first start (n) is in Pa, or NULL. */
static int closest(Program *P, const double *from, double *x, double *slope, Found *found) {
    const Setup *s = P->setup;
    for (int64_t i = 0; from && i < s->n; i++)
        x[i] = clip(from[i] / s->unit[i], P->lower[i], P->upper[i]);
    const ClosestSettings *set = &s->closest;
    Setup own = *s;
    const double *tolerances = P->radius;
    own.terms = 1, own.floors = 0, own.precision = set->precision, own.same_optimum = set->same;
    int64_t n = own.n, balls = own.balls, stages = 0, good = 0;
    double radius[balls], optima[set->compiled_descents * n];
    Descent ends[set->compiled_descents];
    Effort effort;
    Ranked nearest[2 * own.most_effort.screened];
    int64_t count = nearest_samples(P, nearest, &effort);
    memset(found, 0, sizeof *found);
    for (int64_t k = 0; k < balls; k++) {
        radius[k] = own.stage[k] < 0 ? tolerances[k] : FREE; /* obstacles hold in every stage */
        stages = own.stage[k] + 1 > stages ? own.stage[k] + 1 : stages;
    }
    Stage stage = {0, tolerances};
    P->setup = &own, P->radius = radius, P->stage = &stage;
    NEW_POINT(p, &own);
    for (; stage.number < stages; stage.number++) {
        Known known = {0, ends, optima};
        closest_optima(P, stage.number || from ? x : NULL, nearest, count, set, &known, found);
        for (int64_t k = good = 0; !good && k < known.count; k++)
            good = evaluate_from_rest(P, optima + k * n, &p) && p.f[0] < ends[k].value + set->same;
        if (!good) break;
        memcpy(x, p.x, (size_t)n * sizeof(double));
        double least = 0;
        for (int64_t k = 0; k < balls; k++)
            if (own.stage[k] == stage.number) least = fmax(least, p.error[k]);
        for (int64_t k = 0; k < balls && stage.number + 1 < stages; k++)
            if (own.stage[k] == stage.number) radius[k] = fmax(tolerances[k], least * (1 + 1e-6) + 1e-7);
    }
    if (good) { /* descend once more from the end, for its multipliers */
        stage.number = stages - 1;
        P->slope = slope;
        descend(P, &p, NULL);
        good = evaluate_from_rest(P, p.x, &p);
        memcpy(x, p.x, (size_t)n * sizeof(double));
        P->slope = NULL;
    }
    P->setup = s, P->radius = tolerances, P->stage = NULL;
    return good;
}

#endif
