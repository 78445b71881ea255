/* Evaluate the program of an arm without loads, in closed form. */
#ifndef STIFFOPT_FREE_H
#define STIFFOPT_FREE_H

#include "obstacles.h"
#include "program.h"

/* Convert derivatives (rows, n) by pressures to those by x. */
static void per_share(const Setup *s, double *J, int64_t rows) {
    for (int64_t k = 0; k < rows; k++)
        for (int64_t i = 0; i < s->n; i++) J[k * s->n + i] *= s->unit[i];
}

/* Compute residuals at p->x and, if full, terms and floors; return 0 if anything is not finite. */
static int evaluate(Program *P, Point *p, int full) {
    const Setup *s = P->setup;
    int staged = full && P->stage;
    full = full && !staged;
    double pressures[s->n];
    for (int64_t i = 0; i < s->n; i++) pressures[i] = p->x[i] * s->unit[i];
    P->arg[0] = pressures, P->arg[1] = P->parameters;
    P->res[0] = p->r, P->res[1] = p->J;
    int64_t bad;
    if (full) {
        P->res[2] = p->f, P->res[3] = p->df, P->res[4] = p->g, P->res[5] = p->dg;
        bad = point(P->arg, P->res, P->iw, P->w, 0);
        per_share(s, p->df, s->terms);
        per_share(s, p->dg, s->floors);
        P->points++;
    } else {
        bad = pose(P->arg, P->res, P->iw, P->w, 0);
        P->poses++;
    }
    per_share(s, p->J, s->own_rows);
    double *J = p->J + s->own_rows * s->n;
    if (bad || !put_obstacles(P, pressures, NULL, p->r + s->own_rows, J)) return 0;
    int64_t size = s->n + s->rows * (1 + s->n);
    if (!all_finite(p->x, full ? value_count(s) : size)) return 0;
    measure_balls(P, p);
    if (staged) stage_term(P, p);
    return 1;
}

/* Judge pressures by the model alone: residuals, pose, compliance and values. */
static int judge_at(Program *P, const double *pressures, double *answer) {
    const Setup *s = P->setup;
    P->sight = EXACT;
    P->arg[0] = pressures, P->arg[1] = P->parameters;
    double *rows = answer + s->own_rows;
    P->res[0] = answer, answer += s->rows;
    P->res[1] = answer, answer += 16;
    P->res[2] = answer, answer += 36;
    P->res[3] = answer;
    return !judge(P->arg, P->res, P->iw, P->w, 0) && put_obstacles(P, pressures, NULL, rows, NULL);
}

/* Allocate the memory of evaluations; return 0 if there is none. */
static int add_memory(Program *P) { return add_surroundings(P); }

static void free_memory(Program *P) { free(P->around); }

#endif
