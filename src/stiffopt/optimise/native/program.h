/* The nonlinear program of a task at one set of pressures, and small dense algebra.
 *
 * Minimise the largest of the terms over the pressures x, each as a share of its channel's range,
 * with floors g(x) >= bound, balls |r(x)| <= radius (one-sided ones: r(x) <= radius, of one row)
 * and lower <= x <= upper.  The model is generated code, which takes pressures in Pa.
 * All matrices are stored row by row.
 */
#ifndef STIFFOPT_PROGRAM_H
#define STIFFOPT_PROGRAM_H

#include <math.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

/* Settings; documented in settings.py. */
typedef struct {
    double longest_step, damping, least_damping, most_damping, least_progress;
    int64_t iterations, iterations_of_many;
} ReachSettings;

typedef struct {
    int64_t iterations;
    double first_radius, largest_radius, last_radius, curvature, inside, touching, next_to;
    double floor_margin, pull_back_damping, shortest_pull_back;
} DescentSettings;

typedef struct {
    int64_t screened, agreeing, most_descents;
} Effort;

typedef struct {
    int64_t most_descents, agreeing, compiled_descents, compiled_agreeing, samples;
    double same, precision;
} ClosestSettings;

/* Sizes of a task structure and settings; mirrors `_Setup` in fast.py. */
typedef struct {
    int64_t n;     /* pressures */
    int64_t rows;  /* of all residuals */
    int64_t own_rows; /* of generated functions, which come before those of obstacles */
    int64_t balls; /* constraints on the rows */
    int64_t terms, floors, values;
    int64_t parameters;
    int64_t near;    /* terms of the target, each with a `Nearness` */
    int64_t samples; /* in the table */
    const int64_t *ball_rows, *one_sided; /* (balls) */
    const double *scale;                  /* (balls) of residuals far from the target */
    const double *unit;                   /* (n) Pa per unit of x */
    const int64_t *stage;                 /* (balls) in the search of closest.h */
    ReachSettings reach;
    DescentSettings descent;
    ClosestSettings closest;
    Effort least_effort, most_effort;
    double covered, same_optimum, unlike, price_of_floors, price_of_obstacles, precision;
    const double *sample_x;     /* (samples, n) */
    const double *sample_poses; /* (samples, 12): position, rotation by columns */
    /* for an arm under gravity or loads: */
    int64_t state;               /* size of an equilibrium's state, otherwise 0 */
    const double *sample_states; /* (samples, state) */
    const void *rod;             /* Rod */
    /* for a task with a scene: */
    const void *obstacles; /* Obstacles, otherwise NULL */
} Setup;

/* When to stop; mirrors `StopFlag` in stopping.py. */
typedef struct {
    double seconds;          /* from the start of the call; infinite: no limit */
    volatile int64_t cancel; /* nonzero: at once */
} Stop;

/* One stage of the search for the closest configuration: the error of its balls is minimised. */
typedef struct {
    int64_t number;
    const double *radius; /* (balls) of the target */
} Stage;

/* How distances of obstacles are evaluated: KNOWN keeps the rows, whose pressures have not changed;
 * ROUGH computes no slopes; NEAR is exact for near obstacles; EXACT for all. */
enum { KNOWN, ROUGH, NEAR, EXACT };

typedef struct {
    const Setup *setup;
    const Stop *stop; /* NULL: never */
    double deadline;
    const double *parameters, *radius, *lower, *upper, *floor, *near;
    const double **arg;
    double **res;
    casadi_int *iw;
    double *w;
    const Stage *stage; /* of the search for the closest configuration, otherwise NULL */
    double *slope;      /* (n) output: the Lagrangian's gradient at a descent's end, or NULL */
    int64_t poses, points, programs; /* evaluations and quadratic programs so far */
    void *linear; /* Linear: the last equilibrium with its derivatives */
    void *around; /* Surroundings: the body among obstacles */
    int sight;
} Program;

typedef struct {
    double *x;              /* (n) */
    double *r, *J;          /* (rows), (rows, n) */
    double *f, *df;         /* terms (terms), (terms, n) */
    double *g, *dg;         /* floors (floors), (floors, n) */
    double *state;          /* of the equilibrium (setup->state); begins with NaN if unknown */
    double *error;          /* (balls): length of the residual; if one-sided, the residual */
    int reached;
} Point;

/* Number of values of a point that an evaluation computes; point_size is that of all. */
static int64_t value_count(const Setup *s) {
    return s->n + (s->rows + s->terms + s->floors) * (1 + s->n);
}

static int64_t point_size(const Setup *s) { return value_count(s) + s->state + s->balls; }

static Point point_in(const Setup *s, double *memory) {
    Point p;
    p.x = memory, memory += s->n;
    p.r = memory, memory += s->rows;
    p.J = memory, memory += s->rows * s->n;
    p.f = memory, memory += s->terms;
    p.df = memory, memory += s->terms * s->n;
    p.g = memory, memory += s->floors;
    p.dg = memory, memory += s->floors * s->n;
    p.state = memory, memory += s->state;
    p.error = memory;
    p.reached = 0;
    return p;
}

#define NEW_POINT(name, setup)            \
    double name##_memory[point_size(setup)]; \
    Point name = point_in(setup, name##_memory)

static void copy_point(const Setup *s, const Point *from, Point *to) {
    memcpy(to->x, from->x, (size_t)point_size(s) * sizeof(double));
    to->reached = from->reached;
}

/* Start from the equilibrium of another point. */
static void inherit_state(const Setup *s, const Point *from, Point *to) {
    memcpy(to->state, from->state, (size_t)s->state * sizeof(double));
}

/* Start from the unpressurised arm. */
static void forget_state(const Setup *s, Point *p) {
    if (s->state) p->state[0] = NAN;
}

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int stopped(const Program *P) {
    return P->stop && (P->stop->cancel || now() > P->deadline);
}

static double dot(const double *a, const double *b, int64_t n) {
    double sum = 0;
    for (int64_t i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

static double largest(const double *a, int64_t n) {
    double found = 0;
    for (int64_t i = 0; i < n; i++) found = fmax(found, fabs(a[i]));
    return found;
}

static double clip(double x, double low, double high) { return fmin(fmax(x, low), high); }

static int all_finite(const double *a, int64_t n) {
    for (int64_t i = 0; i < n; i++)
        if (!isfinite(a[i])) return 0;
    return 1;
}

/* Solve A y = b in place for symmetric positive definite A (m, m); return 0 if A is not. */
static int cholesky_solve(double *A, double *b, int64_t m) {
    for (int64_t j = 0; j < m; j++) {
        double d = A[j * m + j] - dot(A + j * m, A + j * m, j);
        if (!(d > 0)) return 0;
        A[j * m + j] = d = sqrt(d);
        for (int64_t i = j + 1; i < m; i++)
            A[i * m + j] = (A[i * m + j] - dot(A + i * m, A + j * m, j)) / d;
    }
    for (int64_t i = 0; i < m; i++) b[i] = (b[i] - dot(A + i * m, b, i)) / A[i * m + i];
    for (int64_t i = m - 1; i >= 0; i--) {
        for (int64_t k = i + 1; k < m; k++) b[i] -= A[k * m + i] * b[k];
        b[i] /= A[i * m + i];
    }
    return 1;
}

/* Compute the errors of the constraints, and whether all hold. */
static void measure_balls(const Program *P, Point *p) {
    const Setup *s = P->setup;
    const double *r = p->r;
    p->reached = 1;
    for (int64_t k = 0; k < s->balls; r += s->ball_rows[k++]) {
        p->error[k] = s->one_sided[k] ? r[0] : sqrt(dot(r, r, s->ball_rows[k]));
        p->reached = p->reached && p->error[k] <= P->radius[k];
    }
}

/* Set the weight (rows) of each residual to the reciprocal of its constraint's number. */
static void row_weights(const Setup *s, const double *of_ball, double *weight) {
    for (int64_t k = 0, i = 0; k < s->balls; k++)
        for (int64_t end = i + s->ball_rows[k]; i < end; i++) weight[i] = 1 / of_ball[k];
}

/* Compute the violations of residuals (rows); a one-sided residual counts only beyond its bound.
 * Return their Jacobian, whose rows are zero where a one-sided bound holds; J is memory for it. */
static const double *lacking(const Program *P, const Point *p, double *lacks, double *J) {
    const Setup *s = P->setup;
    const double *found = p->J;
    memcpy(lacks, p->r, (size_t)s->rows * sizeof(double));
    for (int64_t k = 0, i = 0; k < s->balls; i += s->ball_rows[k++]) {
        if (!s->one_sided[k]) continue;
        double inside = s->descent.inside * P->radius[k];
        if (found != J) {
            memcpy(J, p->J, (size_t)(s->rows * s->n) * sizeof(double));
            found = J;
        }
        lacks[i] = fmax(0, p->r[i] - inside);
        if (p->r[i] <= inside) memset(J + i * s->n, 0, (size_t)s->n * sizeof(double));
    }
    return found;
}

/* Replace the objective by that of a stage: half the squared error over its scale. */
static void stage_term(const Program *P, Point *p) {
    const Setup *s = P->setup;
    int64_t n = s->n;
    memset(p->f, 0, (size_t)(1 + n) * sizeof(double));
    for (int64_t k = 0, row = 0; k < s->balls; row += s->ball_rows[k++]) {
        if (s->stage[k] != P->stage->number) continue;
        for (int64_t i = row; i < row + s->ball_rows[k]; i++) {
            double e = p->r[i] / s->scale[k];
            if (s->one_sided[k]) e = fmax(0, (p->r[i] - P->stage->radius[k]) / s->scale[k]);
            p->f[0] += 0.5 * e * e;
            for (int64_t j = 0; j < n; j++) p->df[j] += e * p->J[i * n + j] / s->scale[k];
        }
    }
}

/* Largest term. */
static double objective(const Setup *s, const Point *p) {
    double found = p->f[0];
    for (int64_t i = 1; i < s->terms; i++) found = fmax(found, p->f[i]);
    return found;
}

/* Sum of the violations of obstacles' rows, over their scales. */
static double intrusion(const Program *P, const Point *p) {
    const Setup *s = P->setup;
    double sum = 0;
    for (int64_t i = s->own_rows, k = s->balls - (s->rows - s->own_rows); i < s->rows; i++, k++)
        sum += fmax(0, p->r[i] - P->radius[k]) / s->scale[k];
    return sum;
}

/* Sum of the violations of floors. */
static double violation(const Program *P, const Point *p) {
    double sum = 0;
    for (int64_t i = 0; i < P->setup->floors; i++) sum += fmax(0, P->floor[i] - p->g[i]);
    return sum;
}

#endif
