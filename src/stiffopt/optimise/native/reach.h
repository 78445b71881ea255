/* Bring pressures to the target: damped Gauss-Newton steps within the pressure limits. */
#ifndef STIFFOPT_REACH_H
#define STIFFOPT_REACH_H

#ifdef STIFFOPT_LOADED
#include "loaded.h"
#else
#include "free.h"
#endif

/* Compute the components of d that are not held, from a system of size (rows, rows). */
static int steps_of_few_rows(const Setup *s, const double *J, const int64_t *row, int64_t m,
                             const double *rest, const double *weight, double damping,
                             const int64_t *held, double *d) {
    int64_t n = s->n;
    double A[m * m], y[m];
    for (int64_t i = 0; i < m; i++) {
        for (int64_t j = 0; j <= i; j++) {
            double sum = 0;
            for (int64_t k = 0; k < n; k++)
                if (!held[k]) sum += J[row[i] * n + k] * J[row[j] * n + k];
            A[i * m + j] = A[j * m + i] = sum;
        }
        A[i * m + i] += damping / (weight[row[i]] * weight[row[i]]);
        y[i] = rest[i];
    }
    if (!cholesky_solve(A, y, m)) return 0;
    for (int64_t k = 0; k < n; k++) {
        if (held[k]) continue;
        d[k] = 0;
        for (int64_t i = 0; i < m; i++) d[k] += J[row[i] * n + k] * y[i];
    }
    return 1;
}

/* The same from a system of size (n, n); the two agree by Woodbury's identity. */
static int steps_of_many_rows(const Setup *s, const double *J, const int64_t *row, int64_t m,
                              const double *rest, const double *weight, double damping,
                              const int64_t *held, double *d) {
    int64_t n = s->n, f = 0, free[n];
    for (int64_t k = 0; k < n; k++)
        if (!held[k]) free[f++] = k;
    double A[f * f], y[f];
    memset(A, 0, sizeof A), memset(y, 0, sizeof y);
    for (int64_t i = 0; i < m; i++) {
        const double *own = J + row[i] * n, square = weight[row[i]] * weight[row[i]];
        for (int64_t a = 0; a < f; a++) {
            for (int64_t b = 0; b < f; b++) A[a * f + b] += square * own[free[a]] * own[free[b]];
            y[a] += square * own[free[a]] * rest[i];
        }
    }
    for (int64_t a = 0; a < f; a++) A[a * f + a] += damping;
    if (!cholesky_solve(A, y, f)) return 0;
    for (int64_t a = 0; a < f; a++) d[free[a]] = y[a];
    return 1;
}

/* Compute a step d within [low, high] that makes |W (J d - wanted)|^2 + damping |d|^2 small.
 *
 * Components that leave their range are fixed at its end and the others are solved for again.  Rows
 * of J that are zero, as those of one-sided constraints that hold, are skipped.
 */
static int bounded_step(const Setup *s, const double *J, const double *wanted,
                        const double *weight, double damping, const double *low,
                        const double *high, double *d) {
    int64_t n = s->n, m = 0, held[n], left = n, row[s->rows];
    double rest[s->rows];
    for (int64_t i = 0; i < s->rows; i++)
        if (largest(J + i * n, n) > 0) row[m] = i, rest[m++] = wanted[i];
    memset(held, 0, sizeof held);
    if (m == 0) {
        for (int64_t k = 0; k < n; k++) d[k] = clip(0, low[k], high[k]);
        return 1;
    }
    while (left > 0) {
        int64_t leaving = 0;
        if (!(m > n ? steps_of_many_rows : steps_of_few_rows)(s, J, row, m, rest, weight, damping, held, d))
            return 0;
        for (int64_t k = 0; k < n; k++) leaving += !held[k] && (d[k] < low[k] || d[k] > high[k]);
        if (!leaving) return 1;
        for (int64_t k = 0; k < n; k++) {
            if (held[k] || (d[k] >= low[k] && d[k] <= high[k])) continue;
            d[k] = clip(d[k], low[k], high[k]);
            for (int64_t i = 0; i < m; i++) rest[i] -= J[row[i] * n + k] * d[k];
            held[k] = 1, left--;
        }
    }
    return 1;
}

static double misfit(const Setup *s, const double *lacks, const double *weight) {
    double sum = 0;
    for (int64_t i = 0; i < s->rows; i++) sum += weight[i] * weight[i] * lacks[i] * lacks[i];
    return sum;
}

/* Move a point, starting at p->x, to where all constraints hold; return 0 if that fails. */
static int approach(Program *P, Point *p, int64_t most) {
    const Setup *s = P->setup;
    const ReachSettings *set = &s->reach;
    double weight[s->rows], lacks[s->rows], memory[s->rows * s->n], damping = set->damping;
    double scale[s->balls]; /* large for a free ball, so that it does not pull */
    for (int64_t k = 0; k < s->balls; k++) scale[k] = fmax(s->scale[k], P->radius[k]);
    row_weights(s, scale, weight);
    if (!evaluate(P, p, 0)) return 0;
    if (p->reached) return 1;
    NEW_POINT(trial, s);
    const double *J = lacking(P, p, lacks, memory);
    double before = misfit(s, lacks, weight);
    for (int64_t iteration = 0; iteration < most && !p->reached; iteration++) {
        if (stopped(P)) return 0;
        double wanted[s->rows], low[s->n], high[s->n], d[s->n];
        for (int64_t i = 0; i < s->rows; i++) wanted[i] = -lacks[i];
        for (int64_t i = 0; i < s->n; i++) {
            low[i] = fmax(P->lower[i] - p->x[i], -set->longest_step);
            high[i] = fmin(P->upper[i] - p->x[i], set->longest_step);
        }
        if (!bounded_step(s, J, wanted, weight, damping, low, high, d)) return 0;
        double left = 0;
        for (int64_t i = 0; i < s->rows; i++) {
            double each = weight[i] * (lacks[i] + dot(J + i * s->n, d, s->n));
            left += each * each;
        }
        double promised = before - left;
        if (promised < set->least_progress * before) return 0;
        for (int64_t i = 0; i < s->n; i++)
            trial.x[i] = clip(p->x[i] + d[i], P->lower[i], P->upper[i]);
        double gained = -INFINITY, after = INFINITY, trial_lacks[s->rows], unused[s->rows * s->n];
        inherit_state(s, p, &trial);
        if (evaluate(P, &trial, 0)) {
            lacking(P, &trial, trial_lacks, unused);
            after = misfit(s, trial_lacks, weight), gained = before - after;
        }
        if (gained > 0.1 * promised) {
            copy_point(s, &trial, p);
            J = lacking(P, p, lacks, memory);
            before = after;
            if (gained > 0.7 * promised) damping = fmax(0.1 * damping, set->least_damping);
        } else if ((damping *= 10) > set->most_damping) {
            return 0;
        }
    }
    return p->reached;
}

/* The same without obstacles, whose rows are not evaluated. */
static int reach_blindly(Program *P, Point *p, int64_t most) {
    const Setup *s = P->setup;
    if (!s->obstacles) return approach(P, p, most);
    Setup own = *s;
    own.rows = s->own_rows, own.balls -= s->rows - s->own_rows, own.obstacles = NULL;
    P->setup = &own;
    NEW_POINT(alone, &own);
    memcpy(alone.x, p->x, (size_t)s->n * sizeof(double));
    inherit_state(s, p, &alone);
    int reached = approach(P, &alone, most);
    memcpy(p->x, alone.x, (size_t)s->n * sizeof(double));
    inherit_state(s, &alone, p);
    P->setup = s;
    return reached;
}

/* Evaluate in full, with obstacles at the given sight. */
static int evaluate_by_sight(Program *P, Point *p, int sight) {
    int before = P->sight;
    P->sight = sight;
    int good = evaluate(P, p, 1);
    P->sight = before;
    return good;
}

/* Move a point to where all constraints hold; obstacles are considered from the target on. */
static int reach(Program *P, Point *p, int64_t most) {
    return reach_blindly(P, p, most) && (!P->around || approach(P, p, most));
}

/* Find a point near from->x + d where all constraints hold, evaluated in full; 0 without one. */
static int pulled_back(Program *P, const Point *from, const double *d, const double *lower,
                       const double *upper, Point *to) {
    const Setup *s = P->setup;
    const DescentSettings *set = &s->descent;
    double allowed = 2 * largest(d, s->n) + set->shortest_pull_back, weight[s->rows];
    row_weights(s, P->radius, weight);
    for (int64_t i = 0; i < s->n; i++) to->x[i] = clip(from->x[i] + d[i], lower[i], upper[i]);
    inherit_state(s, from, to);
    for (int tries = 0; tries < 8; tries++) {
        if (!evaluate(P, to, 0)) return 0;
        if (to->reached) return evaluate_by_sight(P, to, KNOWN) && to->reached;
        double wanted[s->rows], low[s->n], high[s->n], back[s->n], memory[s->rows * s->n];
        const double *J = lacking(P, to, wanted, memory);
        for (int64_t k = 0, i = 0; k < s->balls; k++) {
            double share = 0, inside = P->radius[k] * set->inside;
            if (to->error[k] > inside) share = inside / to->error[k] - 1;
            for (int64_t end = i + s->ball_rows[k]; i < end; i++) wanted[i] = share * to->r[i];
        }
        for (int64_t i = 0; i < s->n; i++) {
            low[i] = lower[i] - to->x[i];
            high[i] = upper[i] - to->x[i];
        }
        if (!bounded_step(s, J, wanted, weight, set->pull_back_damping, low, high, back))
            return 0;
        if (!(largest(back, s->n) <= allowed)) return 0;
        for (int64_t i = 0; i < s->n; i++)
            to->x[i] = clip(to->x[i] + back[i], lower[i], upper[i]);
    }
    return 0;
}

#endif
