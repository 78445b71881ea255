/* Minimise the objective along the pose: the feasible-path SQP method of local.py. */
#ifndef STIFFOPT_DESCEND_H
#define STIFFOPT_DESCEND_H

#include <daqp/api.h>

#include "reach.h"

#define FAR 1e6 /* value of an absent bound in the quadratic program */

/* Multipliers of balls (rows), terms and floors at a step. */
typedef struct {
    double *balls, *terms, *floors;
    int known;
} Multipliers;

typedef struct {
    double value, violation;
    int converged;
    int64_t iterations;
} Descent;

/* Compute orthonormal axes (k, k) by rows, the first along a vector; any if that is zero. */
static void axes_along(const double *vector, int64_t k, double *axes) {
    double length = sqrt(dot(vector, vector, k)), first[k], mirror[k];
    memset(axes, 0, (size_t)(k * k) * sizeof(double));
    for (int64_t i = 0; i < k; i++) axes[i * k + i] = 1;
    if (!(length > 0)) return;
    for (int64_t i = 0; i < k; i++) mirror[i] = first[i] = vector[i] / length;
    mirror[0] += copysign(1, first[0]); /* Householder's reflection */
    for (int64_t i = 1; i < k; i++)
        for (int64_t j = 0; j < k; j++)
            axes[i * k + j] -= mirror[i] * mirror[j] / (1 + fabs(first[0]));
    memcpy(axes, first, sizeof first);
}

/* Compute the axes of the box around a ball, the first where the ball will be active; return the
 * length of its multiplier. */
static double box_axes(const Program *P, const Point *p, int64_t ball, int64_t row,
                       const Multipliers *prices, const double *gradient, double *axes) {
    int64_t n = P->setup->n, k = P->setup->ball_rows[ball];
    if (P->setup->one_sided[ball]) return axes[0] = 1, 0.0;
    double pull[k];
    if (prices->known) {
        memcpy(pull, prices->balls + row, sizeof pull);
    } else { /* least-squares estimate of the multiplier */
        double A[k * k];
        for (int64_t i = 0; i < k; i++) {
            for (int64_t j = 0; j < k; j++)
                A[i * k + j] = dot(p->J + (row + i) * n, p->J + (row + j) * n, n);
            pull[i] = -dot(p->J + (row + i) * n, gradient, n);
        }
        double trace = 0;
        for (int64_t i = 0; i < k; i++) trace += A[i * k + i];
        for (int64_t i = 0; i < k; i++) A[i * k + i] += 1e-10 * trace;
        if (!cholesky_solve(A, pull, k)) memset(pull, 0, sizeof pull);
    }
    axes_along(p->error[ball] > 0.9 * P->radius[ball] ? p->r + row : pull, k, axes);
    return sqrt(dot(pull, pull, k));
}

/* Minimise z'Hz/2 + g'z subject to low <= (z, Az) <= high; return 0 without a finite answer. */
static int solve_qp(Program *P, int size, int constraints, double *H, double *g, double *A,
                    double *low, double *high, double *z, double *dual) {
    int sense[constraints];
    memset(sense, 0, sizeof sense);
    DAQPProblem qp = {size, constraints, size, H, g, A, high, low, sense};
    DAQPSettings settings;
    daqp_default_settings(&settings);
    settings.primal_tol = 1e-9;
    DAQPResult result = {.x = z, .lam = dual};
    P->programs++;
    if (!all_finite(H, (int64_t)size * size) || !all_finite(g, size) ||
        !all_finite(A, (int64_t)(constraints - size) * size))
        return 0;
    daqp_quadprog(&result, &qp, &settings);
    return result.exitflag > 0 && all_finite(z, size) && all_finite(dual, constraints);
}

/* Whether a row has no slope, as that of a distant obstacle; it is left out of the program. */
static int is_idle(const Program *P, const Point *p, int64_t ball, int64_t row) {
    const Setup *s = P->setup;
    return s->one_sided[ball] && !(largest(p->J + row * s->n, s->n) > 0);
}

/* Compute a step d (n), the promised decrease of the merit, and new multipliers.
 *
 * The variables are the step d, the largest term t (if there are several) and the floors' slack (if
 * there are any); each ball is a box, and its curvature enters the Hessian.  The new multipliers
 * combine those of the box and of the curvature.  Pressures that are held do not change.
 */
static int quadratic_step(Program *P, const Point *p, const double *B, const int64_t *held,
                          double radius, double price, Multipliers *prices, double *d, double *promised) {
    const Setup *s = P->setup;
    int64_t n = s->n, terms = s->terms > 1 ? s->terms : 0, floors = s->floors;
    int64_t size = n + (terms > 0) + (floors > 0), last = size - 1;
    int64_t extra = terms + floors + s->rows, all = size + extra;
    double H[size * size], g[size], A[extra * size], low[all], high[all], z[size], dual[all];
    int64_t axis_count = 0;
    for (int64_t ball = 0; ball < s->balls; ball++)
        axis_count += s->ball_rows[ball] * s->ball_rows[ball];
    double all_axes[axis_count], *axes = all_axes, pulls[s->balls];
    memset(H, 0, sizeof H), memset(g, 0, sizeof g), memset(A, 0, sizeof A);
    for (int64_t i = 0; i < n; i++) {
        memcpy(H + i * size, B + i * n, (size_t)n * sizeof(double));
        low[i] = held[i] ? 0 : fmax(P->lower[i] - p->x[i], -radius);
        high[i] = held[i] ? 0 : fmin(P->upper[i] - p->x[i], radius);
    }
    for (int64_t i = n; i < size; i++) H[i * size + i] = 1e-6;
    double *row = A, *lo = low + size, *hi = high + size;
    double top = objective(s, p);
    int64_t steepest = 0;
    for (int64_t i = 1; i < s->terms; i++)
        if (p->f[i] > p->f[steepest]) steepest = i;
    if (terms) {
        g[n] = 1, low[n] = -FAR, high[n] = FAR;
        for (int64_t i = 0; i < terms; i++, row += size) {
            memcpy(row, p->df + i * n, (size_t)n * sizeof(double));
            row[n] = -1, *lo++ = -FAR, *hi++ = top - p->f[i];
        }
    } else {
        memcpy(g, p->df, (size_t)n * sizeof(double));
    }
    if (floors) {
        g[last] = price, low[last] = 0, high[last] = FAR;
        for (int64_t i = 0; i < floors; i++, row += size) {
            memcpy(row, p->dg + i * n, (size_t)n * sizeof(double));
            row[last] = 1, *lo++ = P->floor[i] - p->g[i], *hi++ = FAR;
        }
    }
    for (int64_t ball = 0, first = 0; ball < s->balls; ball++) {
        int64_t k = s->ball_rows[ball];
        if (is_idle(P, p, ball, first)) {
            first += k, axes += k * k;
            continue;
        }
        double rho = P->radius[ball] * s->descent.inside;
        double pull = box_axes(P, p, ball, first, prices, p->df + steepest * n, axes);
        pulls[ball] = pull;
        const double *J = p->J + first * n;
        for (int64_t i = 0; i < n; i++)
            for (int64_t j = 0; j < n; j++)
                for (int64_t a = 0; a < k; a++)
                    H[i * size + j] += pull / rho * J[a * n + i] * J[a * n + j];
        for (int64_t a = 0; a < k; a++, row += size) {
            const double *axis = axes + a * k;
            double across = dot(axis, p->r + first, k) / rho;
            for (int64_t b = 0; b < k; b++)
                for (int64_t i = 0; i < n; i++) row[i] += axis[b] * J[b * n + i] / rho;
            *lo++ = s->one_sided[ball] ? -FAR : fmin(-1 - across, 0);
            *hi++ = fmax(1 - across, 0);
        }
        first += k, axes += k * k;
    }
    double full_H[size * size], full_g[size];
    memcpy(full_H, H, sizeof H), memcpy(full_g, g, sizeof g);
    int used = (int)(hi - high);
    if (!solve_qp(P, (int)size, used, H, g, A, low, high, z, dual)) return 0;
    *promised = price * violation(P, p);
    for (int64_t i = 0; i < size; i++)
        *promised -= z[i] * (full_g[i] + 0.5 * dot(full_H + i * size, z, size));
    memcpy(d, z, (size_t)n * sizeof(double));
    const double *weight = dual + size;
    prices->known = 1;
    prices->terms[0] = 1;
    for (int64_t i = 0; i < terms; i++) prices->terms[i] = *weight++;
    for (int64_t i = 0; i < floors; i++) prices->floors[i] = -*weight++;
    axes = all_axes;
    for (int64_t ball = 0, first = 0; ball < s->balls; ball++) {
        int64_t k = s->ball_rows[ball];
        if (is_idle(P, p, ball, first)) {
            prices->balls[first] = 0;
            first += k, axes += k * k;
            continue;
        }
        for (int64_t b = 0; b < k; b++) {
            double sum = 0;
            for (int64_t a = 0; a < k; a++) sum += axes[a * k + b] * weight[a];
            sum += pulls[ball] * dot(p->J + (first + b) * n, d, n);
            prices->balls[first + b] = sum / (P->radius[ball] * s->descent.inside);
        }
        weight += k, first += k, axes += k * k;
    }
    return 1;
}

/* Gradient of the Lagrangian for fixed multipliers, bounds left out. */
static void lagrangian_slope(const Setup *s, const Point *p, const Multipliers *prices,
                             double *slope) {
    int64_t n = s->n;
    memset(slope, 0, (size_t)n * sizeof(double));
    for (int64_t i = 0; i < n; i++) {
        for (int64_t k = 0; k < s->terms; k++) slope[i] += prices->terms[k] * p->df[k * n + i];
        for (int64_t k = 0; k < s->floors; k++) slope[i] -= prices->floors[k] * p->dg[k * n + i];
        for (int64_t k = 0; k < s->rows; k++) slope[i] += prices->balls[k] * p->J[k * n + i];
    }
}

/* Whether a step off a pressure limit met a slope back to it.  If the step gained nothing, there is
 * a kink at the limit, as in the norm law where a segment is unpressurised. */
static int is_pushed_back(const Program *P, const Point *p, int64_t i, double rise) {
    return rise > 0 && (p->x[i] <= P->lower[i] || p->x[i] >= P->upper[i]);
}

/* Powell's damped update, which keeps B positive definite. */
static void update_hessian(double *B, const double *step, double *y, int64_t n) {
    double Bs[n];
    for (int64_t i = 0; i < n; i++) Bs[i] = dot(B + i * n, step, n);
    double sBs = dot(step, Bs, n), sy = dot(step, y, n);
    if (!(sBs >= 1e-16)) return;
    if (sy < 0.2 * sBs) {
        double theta = 0.8 * sBs / (sBs - sy);
        for (int64_t i = 0; i < n; i++) y[i] = theta * y[i] + (1 - theta) * Bs[i];
        sy = dot(step, y, n);
    }
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++)
            B[i * n + j] += y[i] * y[j] / sy - Bs[i] * Bs[j] / sBs;
}

/* Move pressures that almost touch a limit onto it, if the point then still holds. */
static void snap(Program *P, Point *p) {
    const Setup *s = P->setup;
    int64_t n = s->n, moved = 0;
    double lower[n], upper[n], d[n];
    for (int64_t i = 0; i < n; i++) {
        int low = p->x[i] < P->lower[i] + s->descent.touching;
        int high = p->x[i] > P->upper[i] - s->descent.touching;
        double x = low ? P->lower[i] : high ? P->upper[i] : p->x[i];
        d[i] = x - p->x[i];
        moved += d[i] != 0;
        lower[i] = high ? P->upper[i] : P->lower[i];
        upper[i] = low ? P->lower[i] : P->upper[i];
    }
    NEW_POINT(other, s);
    if (!moved || !pulled_back(P, p, d, lower, upper, &other)) return;
    if (violation(P, &other) <= violation(P, p) &&
        objective(s, &other) - objective(s, p) < 100 * s->precision)
        copy_point(s, &other, p);
}

/* Known optima; a descent that comes close to one of them ends there. */
typedef struct {
    int64_t count;
    Descent *ends;
    double *x; /* (count, n) */
} Known;

static const Descent *close_known(const Setup *s, const Point *p, const Known *known) {
    double value = objective(s, p);
    for (int64_t k = 0; k < known->count; k++) {
        const double *x = known->x + k * s->n;
        if (fabs(value - known->ends[k].value) > s->same_optimum) continue;
        double far = 0;
        for (int64_t i = 0; i < s->n; i++) far = fmax(far, fabs(p->x[i] - x[i]));
        if (far < s->descent.next_to) return known->ends + k;
    }
    return NULL;
}

/* Initial estimate B (n, n) of the Hessian; for a stage, the Gauss-Newton matrix. */
static void first_curvature(const Program *P, const Point *p, double *B) {
    const Setup *s = P->setup;
    int64_t n = s->n;
    double trace = 0;
    memset(B, 0, (size_t)(n * n) * sizeof(double));
    for (int64_t k = 0, row = 0; P->stage && k < s->balls; row += s->ball_rows[k++]) {
        if (s->stage[k] != P->stage->number) continue;
        for (int64_t r = row * n; r < (row + s->ball_rows[k]) * n; r += n)
            for (int64_t i = 0; i < n; i++)
                for (int64_t j = 0; j < n; j++)
                    B[i * n + j] += p->J[r + i] * p->J[r + j] / (s->scale[k] * s->scale[k]);
    }
    for (int64_t i = 0; i < n; i++) trace += B[i * n + i];
    for (int64_t i = 0; i < n; i++) B[i * n + i] += P->stage ? 1e-8 * trace : s->descent.curvature;
}

/* Minimise the objective from a point that reaches the pose and was evaluated in full. */
static Descent descend(Program *P, Point *p, const Known *known) {
    const Setup *s = P->setup;
    const DescentSettings *set = &s->descent;
    int64_t n = s->n, held[n];
    double B[n * n], d[n], before[n], after[n], step[n];
    double ball_prices[s->rows], term_prices[s->terms], floor_prices[s->floors + 1];
    Multipliers prices = {ball_prices, term_prices, floor_prices, 0};
    double radius = set->first_radius, price = 10, promised = 0;
    Descent end = {0, 0, 0, 0};
    first_curvature(P, p, B);
    memset(held, 0, sizeof held);
    NEW_POINT(trial, s);
    while (end.iterations++ < set->iterations && !stopped(P)) {
        if (!quadratic_step(P, p, B, held, radius, price, &prices, d, &promised)) break;
        for (int64_t i = 0; i < s->floors; i++) price = fmax(price, 2 * prices.floors[i]);
        if (promised < s->precision) {
            end.converged = 1;
            break;
        }
        double length = largest(d, n);
        if (!pulled_back(P, p, d, P->lower, P->upper, &trial)) {
            radius = 0.3 * length;
            if (radius < set->last_radius) break;
            continue;
        }
        double gained = objective(s, p) + price * violation(P, p) - objective(s, &trial) -
                        price * violation(P, &trial);
        lagrangian_slope(s, p, &prices, before);
        lagrangian_slope(s, &trial, &prices, after);
        for (int64_t i = 0; i < n; i++) {
            step[i] = trial.x[i] - p->x[i];
            held[i] = !(gained > 0) && (held[i] || is_pushed_back(P, p, i, step[i] * after[i]));
            after[i] -= before[i];
        }
        update_hessian(B, step, after, n);
        double share = gained / promised;
        if (share < 0.25)
            radius = 0.4 * length;
        else if (share > 0.7 && length > 0.8 * radius)
            radius = fmin(2.5 * radius, set->largest_radius);
        if (gained > 0) {
            copy_point(s, &trial, p);
            const Descent *same = known ? close_known(s, p, known) : NULL;
            if (same) {
                int64_t iterations = end.iterations;
                end = *same, end.iterations = iterations;
                return end;
            }
        }
        if (radius < set->last_radius) {
            end.converged = fabs(promised) < 1e3 * s->precision;
            break;
        }
    }
    snap(P, p);
    if (P->slope && prices.known) lagrangian_slope(s, p, &prices, P->slope);
    end.value = objective(s, p);
    end.violation = violation(P, p);
    return end;
}

#endif
