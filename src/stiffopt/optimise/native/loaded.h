/* Evaluate the program of an arm under gravity or loads, at its equilibrium. */
#ifndef STIFFOPT_LOADED_H
#define STIFFOPT_LOADED_H

#include "obstacles.h"
#include "program.h"
#include "rod.h"

/* Set the inputs of the generated functions of the tip: position (3), rotation (3, 3), twist per
 * wrench in base axes (6, 6), pressures and parameters; matrices are stored by columns. */
static void tip_inputs(const Program *P, const Linear *l, double *R, double *C) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) R[3 * j + i] = l->R[3 * i + j];
    memcpy(C, l->twist, 36 * sizeof(double));
    P->arg[0] = l->r, P->arg[1] = R, P->arg[2] = C, P->arg[3] = l->state;
    P->arg[4] = P->parameters;
}

static Work work_of(const Program *P) { return (Work){P->arg, P->res, P->iw, P->w}; }

/* Add the gradient by the pressures (n) of a value with derivatives G by C (6, 6, by columns).
 *
 * Full pivoting splits G into products y z' (as many as its rank, one for a directional stiffness).
 * Each product takes one backward sweep along the arm.
 */
static int add_by_compliance(const Program *P, const Linear *l, double *G, double *gradient) {
    Work work = work_of(P);
    const Rod *rod = P->setup->rod;
    double first = 0;
    for (int rank = 0; rank < 6; rank++) {
        int top = 0;
        for (int i = 1; i < 36; i++)
            if (fabs(G[i]) > fabs(G[top])) top = i;
        double pivot = G[top], y[6], z[6];
        if (rank == 0) first = fabs(pivot);
        if (!(fabs(pivot) > 1e-11 * first)) return 1;
        for (int i = 0; i < 6; i++) y[i] = G[6 * (top / 6) + i], z[i] = G[6 * i + top % 6] / pivot;
        for (int i = 0; i < 36; i++) G[i] -= y[i % 6] * z[i / 6];
        if (!add_curvature(&work, rod, l, y, z, gradient)) return 0;
    }
    return 1;
}

/* Compute residuals at p->x and, if full, terms and floors; p->state moves to the new equilibrium.
 * Return 0 if there is none next to it, or if anything is not finite. */
static int evaluate(Program *P, Point *p, int full) {
    const Setup *s = P->setup;
    const Rod *rod = s->rod;
    Linear *l = P->linear;
    Work work = work_of(P);
    int staged = full && P->stage;
    full = full && !staged;
    int64_t n = s->n, values = s->terms + s->floors;
    double pressures[n], R[9], C[36], by_twist[6 * s->own_rows];
    for (int64_t i = 0; i < n; i++) pressures[i] = p->x[i] * s->unit[i];
    *(full ? &P->points : &P->poses) += 1;
    if (isnan(p->state[0])) {
        if (!settle(&work, rod, pressures, p->state)) {
            forget_state(s, p);
            return 0;
        }
    } else if (!settle_nearby(&work, rod, pressures, 0, p->state)) {
        return 0;
    }
    if (!linearise(&work, rod, p->state, l)) return 0;
    double twist[6 * n];
    for (int64_t i = 0; i < n; i++) body_twist(l, i, twist + 6 * i);
    tip_inputs(P, l, R, C);
    P->res[0] = p->r, P->res[1] = by_twist;
    if (residuals(P->arg, P->res, P->iw, P->w, 0)) return 0;
    for (int64_t k = 0; k < s->own_rows; k++)
        for (int64_t i = 0; i < n; i++) {
            double sum = 0;
            for (int j = 0; j < 6; j++) sum += by_twist[j * s->own_rows + k] * twist[6 * i + j];
            p->J[k * n + i] = sum * s->unit[i];
        }
    double *J = p->J + s->own_rows * n;
    if (!put_obstacles(P, pressures, p->state, p->r + s->own_rows, J)) return 0;
    tip_inputs(P, l, R, C);
    if (full) {
        double value[values], value_twist[values * 6], value_C[values * 36], value_p[values * n];
        P->res[0] = value, P->res[1] = value_twist, P->res[2] = value_C, P->res[3] = value_p;
        if (terms(P->arg, P->res, P->iw, P->w, 0)) return 0;
        for (int64_t k = 0; k < values; k++) {
            double *gradient = k < s->terms ? p->df + k * n : p->dg + (k - s->terms) * n, G[36];
            if (k < s->terms)
                p->f[k] = value[k];
            else
                p->g[k - s->terms] = value[k];
            for (int64_t i = 0; i < n; i++) {
                gradient[i] = value_p[i * values + k];
                for (int j = 0; j < 6; j++)
                    gradient[i] += value_twist[j * values + k] * twist[6 * i + j];
            }
            for (int i = 0; i < 36; i++) G[i] = value_C[i * values + k];
            if (!add_by_compliance(P, l, G, gradient)) return 0;
            for (int64_t i = 0; i < n; i++) gradient[i] *= s->unit[i];
        }
    }
    int64_t size = n + s->rows * (1 + n);
    if (!all_finite(p->x, full ? value_count(s) : size)) return 0;
    measure_balls(P, p);
    if (staged) stage_term(P, p);
    return 1;
}

/* Judge pressures by the model alone, from rest: residuals, pose, compliance and values. */
static int judge_at(Program *P, const double *pressures, double *answer) {
    const Setup *s = P->setup;
    P->sight = EXACT;
    Linear *l = P->linear;
    Work work = work_of(P);
    double state[s->state], R[9], C[36];
    if (!settle(&work, s->rod, pressures, state) || !linearise(&work, s->rod, state, l)) return 0;
    tip_inputs(P, l, R, C);
    double *rows = answer + s->own_rows;
    P->res[0] = answer, answer += s->rows;
    P->res[1] = answer, answer += 16;
    P->res[2] = answer, answer += 36;
    P->res[3] = answer;
    return !judge(P->arg, P->res, P->iw, P->w, 0) && put_obstacles(P, pressures, state, rows, NULL);
}

/* Allocate the memory of evaluations, with the last equilibrium; return 0 if there is none. */
static int add_memory(Program *P) {
    const Rod *rod = P->setup->rod;
    size_t numbers = (size_t)linear_size(rod) * sizeof(double);
    if (!add_surroundings(P)) return 0;
    if (P->linear) return 1; /* shared with the body among obstacles */
    Linear *l = malloc(sizeof(Linear) + numbers);
    if (l) *l = linear_in(rod, (double *)(l + 1));
    P->linear = l;
    return l != NULL;
}

static void free_memory(Program *P) { free(P->around ? P->around : P->linear); }

#endif
