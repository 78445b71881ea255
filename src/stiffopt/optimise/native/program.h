/* The nonlinear program of a task at one set of pressures, and small dense algebra.
 *
 * Minimise the largest of the terms over the pressures x (in bar), with floors g(x) >= bound,
 * balls |r(x)| <= radius and lower <= x <= upper.  The model itself is generated code.
 * All matrices are stored row by row.
 */
#ifndef STIFFOPT_PROGRAM_H
#define STIFFOPT_PROGRAM_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define BAR 1e5
#define MOST_BALLS 2
#define MOST_ROWS 6

/* Sizes of a task structure and settings; mirrors `_Setup` in fast.py. */
typedef struct {
    int64_t n;        /* pressures */
    int64_t rows;     /* of all residuals */
    int64_t balls;    /* position, angle */
    int64_t ball_rows[MOST_BALLS];
    int64_t terms, floors, values;
    int64_t parameters;
    int64_t samples;           /* in the table */
    int64_t nearest;           /* samples that are brought to the pose */
    int64_t screened;          /* of them, at most so many that came to it are ranked */
    int64_t agreeing;          /* descents that must find nothing new before a search ends */
    int64_t most_descents;
    int64_t most_iterations;
    double scale[MOST_BALLS]; /* of residuals while the pose is far */
    double first_radius, last_radius;
    double precision, curvature;
    double inside, touching, floor_slack, same;
    const double *sample_x;     /* (samples, n) in bar */
    const double *sample_poses; /* (samples, 12): position, rotation by columns */
    /* of an arm under gravity or loads: */
    int64_t state;               /* numbers of an equilibrium's state, else 0 */
    const double *sample_states; /* (samples, state) */
    const void *rod;             /* Rod */
} Setup;

typedef struct {
    const Setup *setup;
    const double *parameters, *radius, *lower, *upper, *floor, *near;
    const double **arg;
    double **res;
    casadi_int *iw;
    double *w;
    int64_t poses, points, programs; /* evaluations and quadratic programs so far */
    void *linear; /* Linear: the last equilibrium with its derivatives */
} Program;

typedef struct {
    double *x;              /* (n) */
    double *r, *J;          /* (rows), (rows, n) */
    double *f, *df;         /* terms (terms), (terms, n) */
    double *g, *dg;         /* floors (floors), (floors, n) */
    double *state;          /* of the equilibrium (setup->state); NaN where none is known */
    double error[MOST_BALLS];
    int reached;
} Point;

/* Numbers of a point that an evaluation gives, and all. */
static int64_t value_count(const Setup *s) {
    return s->n + (s->rows + s->terms + s->floors) * (1 + s->n);
}

static int64_t point_size(const Setup *s) { return value_count(s) + s->state; }

static Point point_in(const Setup *s, double *memory) {
    Point p;
    p.x = memory, memory += s->n;
    p.r = memory, memory += s->rows;
    p.J = memory, memory += s->rows * s->n;
    p.f = memory, memory += s->terms;
    p.df = memory, memory += s->terms * s->n;
    p.g = memory, memory += s->floors;
    p.dg = memory, memory += s->floors * s->n;
    p.state = memory;
    p.error[0] = p.error[1] = 0;
    p.reached = 0;
    return p;
}

#define NEW_POINT(name, setup)            \
    double name##_memory[point_size(setup)]; \
    Point name = point_in(setup, name##_memory)

static void copy_point(const Setup *s, const Point *from, Point *to) {
    memcpy(to->x, from->x, (size_t)point_size(s) * sizeof(double));
    to->error[0] = from->error[0], to->error[1] = from->error[1];
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

static double dot(const double *a, const double *b, int64_t n) {
    double sum = 0;
    for (int64_t i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

static double largest(const double *a, int64_t n) {
    double most = 0;
    for (int64_t i = 0; i < n; i++) most = fmax(most, fabs(a[i]));
    return most;
}

static double clip(double x, double low, double high) { return fmin(fmax(x, low), high); }

static int all_finite(const double *a, int64_t n) {
    for (int64_t i = 0; i < n; i++)
        if (!isfinite(a[i])) return 0;
    return 1;
}

static void multiply(double *a, double factor, int64_t n) {
    for (int64_t i = 0; i < n; i++) a[i] *= factor;
}

/* Solve A y = b with A (m, m) symmetric positive definite, in place; 0 if it is not. */
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

/* Lengths of the residuals, and whether each lies in its ball. */
static void measure_balls(const Program *P, Point *p) {
    const double *r = p->r;
    p->reached = 1;
    for (int64_t k = 0; k < P->setup->balls; k++) {
        int64_t rows = P->setup->ball_rows[k];
        p->error[k] = sqrt(dot(r, r, rows));
        p->reached = p->reached && p->error[k] <= P->radius[k];
        r += rows;
    }
}

/* Largest term, and the sum by which floors are missed. */
static double objective(const Setup *s, const Point *p) {
    double most = p->f[0];
    for (int64_t i = 1; i < s->terms; i++) most = fmax(most, p->f[i]);
    return most;
}

static double violation(const Program *P, const Point *p) {
    double sum = 0;
    for (int64_t i = 0; i < P->setup->floors; i++) sum += fmax(0, P->floor[i] - p->g[i]);
    return sum;
}

#endif
