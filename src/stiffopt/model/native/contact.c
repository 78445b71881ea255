/* Newton's method for an arm in contact with surfaces, as in `stiffopt.model.contact`.
 *
 * The arm is divided into steps from its tip to its base.  Changes are propagated along the
 * unknowns: a turn of the tip (3), and force (3) and station of each contact; the last columns hold
 * the defects of the nodes' states, or the changes along a force and moment on the tip.  Matrices
 * are stored by rows, except those of generated functions.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "functions.h"
#include "work.h"

#define MOST_CONTACTS 24
#define MOST_STEPS 128
#define MOST_EXTRAS 6
#define MOST_COLUMNS (3 + 4 * MOST_CONTACTS + MOST_EXTRAS)
#define MOST_UNKNOWNS (3 + 5 * MOST_CONTACTS)
#define LEAST_LEFT_TURN 1e-6 /* these mirror solve.py */
#define LEAST_LEFT_SLIDE 1e-7
#define LARGEST_TURN 0.5
#define FARTHEST_TURN 1.5
#define LARGEST_SLIDE 0.02
#define MOST_ITERATIONS 14
#define STRETCHED 1.3
#define RIGID 1e-3 /* and these stability.py */
#define FLATTEST 1e-3
#define HELD 1e8 /* N/m, stiffness of a rigid surface: far above that of any part of an arm */

enum { CONVERGED = 0, LOST = 1, REMESH = 2 };

typedef int (*SurfaceFormula)(const double **arg, double **res, casadi_int *iw, double *w, int mem);

/* Mirrored by `_Surface` in contact/native.py. */
typedef struct {
    SurfaceFormula distance, formula; /* the latter with normal and curvature */
    int64_t pieces, size;
    const double *parameters; /* (pieces, size) */
    double softness;
} Surface;

/* Mirrored by `_Touch`. */
typedef struct {
    int64_t surface, pinned, segment, rigid, node;
    double start, end; /* of its range */
    double station, force[3], normal_force;
    double distance, normal[3], curvature[9], gap, mean[3], slope; /* output */
} Touch;

/* Mirrored by `_Problem`. */
typedef struct {
    int64_t steps, contacts;
    const int64_t *segment;                          /* of each step */
    const uint8_t *rigid;
    const double *per_station;                       /* (steps, contacts) */
    const double *longest, *strain, *compliance, *radius, *weight, *centroid; /* of each segment */
    const double *retreat;                           /* of each surface */
    double length, dead[6], follower[6], tip_load[3];
    const Surface *surfaces;
    Touch *touches;
    double *at, *q, *m;                              /* (steps + 1, ...), updated in place */
    double *position, *force_far, *moment_far, *J, *near, *far; /* output */
} Problem;

int64_t stiffopt_contact_sizes(int64_t which) {
    return which == 0 ? sizeof(Surface) : which == 1 ? sizeof(Touch) : sizeof(Problem);
}

static void cross(const double *a, const double *b, double *c) {
    c[0] = a[1] * b[2] - a[2] * b[1], c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void rotation(const double *q, double R[9]) {
    double s = 1 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    double w = q[0] * s, x = q[1] * s, y = q[2] * s, z = q[3] * s;
    R[0] = 1 - 2 * (y * y + z * z), R[1] = 2 * (x * y - w * z), R[2] = 2 * (x * z + w * y);
    R[3] = 2 * (x * y + w * z), R[4] = 1 - 2 * (x * x + z * z), R[5] = 2 * (y * z - w * x);
    R[6] = 2 * (x * z - w * y), R[7] = 2 * (y * z + w * x), R[8] = 1 - 2 * (x * x + y * y);
}

static void times(const double *A, const double *v, double *to) {
    for (int i = 0; i < 3; i++) to[i] = dot(A + 3 * i, v);
}

static void transposed_times(const double *A, const double *v, double *to) {
    for (int i = 0; i < 3; i++) to[i] = A[i] * v[0] + A[3 + i] * v[1] + A[6 + i] * v[2];
}

/* Compute the rotation vector in base axes between two nearby quaternions. */
static void turn_between(const double *a, const double *b, double *turn) {
    double real = b[0] * a[0] + dot(b + 1, a + 1), c[3];
    cross(b + 1, a + 1, c);
    for (int i = 0; i < 3; i++) turn[i] = 2 * (a[0] * b[1 + i] - b[0] * a[1 + i] - c[i]) / real;
}

static void turn_by(double *q, const double *turn) {
    double h[3] = {turn[0] / 2, turn[1] / 2, turn[2] / 2}, c[3], to[4], size = 0;
    cross(h, q + 1, c);
    to[0] = q[0] - dot(h, q + 1);
    for (int i = 0; i < 3; i++) to[1 + i] = q[1 + i] + q[0] * h[i] + c[i];
    for (int i = 0; i < 4; i++) size += to[i] * to[i];
    for (int i = 0; i < 4; i++) q[i] = to[i] / sqrt(size);
}

typedef struct {
    int64_t columns, extras; /* 1 for the defects, 6 for a wrench on the tip */
    double X[MOST_STEPS + 1][9][MOST_COLUMNS]; /* of turn, moment, force at the nodes */
    double moves[MOST_STEPS + 1][3][MOST_COLUMNS];
    double force[3];
} Changes;

static int step_ahead(const Work *work, const Problem *p, int64_t i, const double *n, double *end,
                      double *J) {
    double h = p->at[i] - p->at[i + 1], tangents[6], R[9];
    const double *q = p->q + 4 * i, *m = p->moment_far + 3 * i;
    int64_t s = p->segment[i];
    if (!p->rigid[i]) {
        work->arg[0] = q, work->arg[1] = m, work->arg[2] = n, work->arg[3] = p->strain + 6 * s;
        work->arg[4] = p->compliance + 36 * s, work->arg[5] = p->centroid + 2 * s;
        work->arg[6] = p->weight + 3 * s, work->arg[7] = &h;
        work->res[0] = end, work->res[1] = tangents, work->res[2] = J;
        if (contact_step(work->arg, work->res, work->iw, work->w, 0)) return 0;
        memcpy(p->near + 3 * i, tangents, 3 * sizeof(double));
        memcpy(p->far + 3 * i, tangents + 3, 3 * sizeof(double));
        return 1;
    }
    rotation(q, R);
    double axis[3] = {R[2], R[5], R[8]}, gain[3];
    cross(axis, n, gain);
    memcpy(end, q, 4 * sizeof(double)), memset(J, 0, 90 * sizeof(double));
    for (int k = 0; k < 3; k++) {
        end[4 + k] = -h * axis[k], end[7 + k] = m[k] + h * gain[k];
        p->near[3 * i + k] = p->far[3 * i + k] = axis[k];
        J[9 * k + k] = J[9 * (3 + k) + 6 + k] = 1;
        double e[3] = {k == 0, k == 1, k == 2}, turned[3], arm[3], own[3];
        cross(e, axis, turned), cross(turned, n, arm), cross(axis, e, own);
        for (int r = 0; r < 3; r++) {
            J[9 * k + 3 + r] = -h * turned[r], J[9 * k + 6 + r] = h * arm[r];
            J[9 * (6 + k) + 6 + r] = h * own[r];
        }
        J[81 + 3 + k] = -axis[k], J[81 + 6 + k] = gain[k];
    }
    return 1;
}

/* Linearise the rod about its state: positions, tangents, forces, and all changes. */
static int linearise(const Work *work, const Problem *p, Changes *c, int64_t extras) {
    int64_t k = p->contacts, last = 3 + 4 * k, N = p->steps;
    double R[9], f[3], m[3], n[3], ways[MOST_STEPS][3];
    c->columns = last + extras, c->extras = extras;
    memset(c->X[0], 0, sizeof c->X[0]);
    rotation(p->q, R), times(R, p->follower, f), times(R, p->follower + 3, m);
    for (int i = 0; i < 3; i++) {
        n[i] = p->dead[i] + f[i] + p->tip_load[i];
        p->moment_far[i] = p->dead[3 + i] + m[i];
        double e[3] = {i == 0, i == 1, i == 2}, df[3], dm[3];
        cross(e, f, df), cross(e, m, dm);
        c->X[0][i][i] = 1;
        for (int r = 0; r < 3; r++) c->X[0][6 + r][i] = df[r], c->X[0][3 + r][i] = dm[r];
        if (extras == 6) c->X[0][6 + i][last + i] = c->X[0][3 + i][last + 3 + i] = 1;
    }
    for (int64_t i = 0; i < N; i++) {
        double end[10], *J = p->J + 90 * i, Y[9][MOST_COLUMNS];
        memcpy(p->force_far + 3 * i, n, sizeof n);
        if (i) memcpy(p->moment_far + 3 * i, p->m + 3 * i, 3 * sizeof(double));
        double N9[9][MOST_COLUMNS];
        memcpy(N9, c->X[i], sizeof N9);
        for (int64_t j = 0; j < k; j++)
            if (p->touches[j].node == i)
                for (int r = 0; r < 3; r++) n[r] += p->touches[j].force[r], N9[6 + r][3 + 4 * j + r] += 1;
        if (!step_ahead(work, p, i, n, end, J)) return 0;
        for (int r = 0; r < 9; r++)
            for (int64_t col = 0; col < c->columns; col++) {
                double sum = 0;
                for (int b = 0; b < 9; b++) sum += J[9 * b + r] * N9[b][col];
                Y[r][col] = sum;
            }
        double h = p->at[i] - p->at[i + 1], turn[3];
        const double *weight = p->weight + 3 * p->segment[i];
        for (int64_t j = 0; j < k; j++) {
            double share = p->per_station[k * i + j];
            if (share == 0) continue;
            for (int r = 0; r < 9; r++) Y[r][6 + 4 * j] += share * J[81 + r];
            for (int r = 0; r < 3 && !p->rigid[i]; r++) N9[6 + r][6 + 4 * j] += share * weight[r];
        }
        turn_between(p->q + 4 * (i + 1), end, turn);
        for (int r = 0; r < 3; r++) {
            if (extras == 1) Y[r][last] += turn[r], Y[6 + r][last] += end[7 + r] - p->m[3 * (i + 1) + r];
            ways[i][r] = end[4 + r];
            if (!p->rigid[i]) n[r] += h * weight[r];
        }
        memcpy(c->X[i + 1], Y, 3 * sizeof Y[0]);
        memcpy(c->X[i + 1] + 3, Y + 6, 3 * sizeof Y[0]);
        memcpy(c->X[i + 1] + 6, N9 + 6, 3 * sizeof Y[0]);
        memcpy(c->moves[i], Y + 3, 3 * sizeof Y[0]);
    }
    memcpy(p->force_far + 3 * N, n, sizeof n);
    memcpy(p->moment_far + 3 * N, p->m + 3 * N, 3 * sizeof(double));
    memset(c->moves[N], 0, sizeof c->moves[N]), memset(p->position + 3 * N, 0, 3 * sizeof(double));
    for (int64_t i = N - 1; i >= 0; i--)
        for (int r = 0; r < 3; r++) {
            p->position[3 * i + r] = p->position[3 * (i + 1) + r] - ways[i][r];
            for (int64_t col = 0; col < c->columns; col++)
                c->moves[i][r][col] = c->moves[i + 1][r][col] - c->moves[i][r][col];
        }
    return 1;
}

/* Return the distance of a point from a surface and its nearest piece; -INFINITY where it fails. */
static double distance_from(const Work *work, const Surface *surface, const double *point,
                            const double **piece) {
    double largest = -INFINITY, value;
    work->res[0] = &value;
    for (int64_t i = 0; i < surface->pieces; i++) {
        work->arg[0] = point, work->arg[1] = surface->parameters + i * surface->size;
        if (surface->distance(work->arg, work->res, work->iw, work->w, 0)) return -INFINITY;
        if (value > largest) largest = value, *piece = work->arg[1];
    }
    return largest;
}

/* Compute distance, normal and curvature of a surface at a point. */
static int look_at(const Work *work, const Surface *surface, const double *point, Touch *to) {
    const double *piece;
    if (!isfinite(distance_from(work, surface, point, &piece))) return 0;
    work->arg[0] = point, work->arg[1] = piece;
    work->res[0] = &to->distance, work->res[1] = to->normal, work->res[2] = to->curvature;
    return !surface->formula(work->arg, work->res, work->iw, work->w, 0);
}

/* Compute the mean tangent at a contact, and its change. */
static void mean_tangent(const Problem *p, const Changes *c, int64_t j, const double *R, double *mean,
                         double change[3][MOST_COLUMNS]) {
    const Touch *touch = p->touches + j;
    const double *C = p->compliance + 36 * touch->segment, *strain = p->strain + 6 * touch->segment;
    const double(*X)[MOST_COLUMNS] = c->X[touch->node];
    double local[6], n[3], m[3];
    memcpy(m, p->moment_far + 3 * touch->node, sizeof m);
    for (int i = 0; i < 3; i++) n[i] = p->force_far[3 * touch->node + i] + touch->force[i] / 2;
    transposed_times(R, n, local), transposed_times(R, m, local + 3);
    double v[3] = {0, 0, 1};
    for (int i = 0; i < 3 && !touch->rigid; i++) {
        v[i] = strain[i];
        for (int b = 0; b < 6; b++) v[i] += C[6 * b + i] * local[b];
    }
    times(R, v, mean);
    for (int64_t col = 0; col < c->columns; col++) {
        double turn[3] = {X[0][col], X[1][col], X[2][col]}, with[3], dv[3] = {0, 0, 0}, dw[6];
        cross(turn, mean, with);
        if (!touch->rigid) {
            double dn[3], dm[3], a[3], b[3];
            for (int i = 0; i < 3; i++) {
                dn[i] = X[6 + i][col] + (col == 3 + 4 * j + i ? 0.5 : 0);
                dm[i] = X[3 + i][col];
            }
            cross(turn, n, a), cross(turn, m, b);
            for (int i = 0; i < 3; i++) dn[i] -= a[i], dm[i] -= b[i];
            transposed_times(R, dn, dw), transposed_times(R, dm, dw + 3);
            for (int i = 0; i < 3; i++)
                for (int e = 0; e < 6; e++) dv[i] += C[6 * e + i] * dw[e];
        }
        double own[3];
        times(R, dv, own);
        for (int i = 0; i < 3; i++) change[i][col] = with[i] + own[i];
    }
}

/* Assemble the equations of the base and of the contacts, A (u, u) and b (u, extras). */
static int assemble(const Work *work, const Problem *p, const Changes *c, double *A, double *b) {
    int64_t k = p->contacts, last = 3 + 4 * k, u = 3 + 5 * k, extras = c->extras;
    memset(A, 0, (size_t)(u * u) * sizeof(double));
    for (int r = 0; r < 3; r++) {
        memcpy(A + r * u, c->X[p->steps][r], (size_t)last * sizeof(double));
        for (int64_t e = 0; e < extras; e++) b[r * extras + e] = -c->X[p->steps][r][last + e];
    }
    for (int64_t j = 0; j < k; j++) {
        Touch *touch = p->touches + j;
        const Surface *surface = p->surfaces + touch->surface;
        if (!look_at(work, surface, p->position + 3 * touch->node, touch)) return 0;
        double change[3][MOST_COLUMNS], R[9], f = touch->normal_force, *n = touch->normal;
        const double *H = touch->curvature;
        const double(*dc)[MOST_COLUMNS] = c->moves[touch->node];
        rotation(p->q + 4 * touch->node, R);
        mean_tangent(p, c, j, R, touch->mean, change);
        touch->slope = dot(n, touch->mean);
        touch->gap = touch->distance - p->radius[touch->segment] + p->retreat[touch->surface] +
                     surface->softness * f;
        int64_t first = 3 + 4 * j;
        double bent[3];
        times(H, touch->mean, bent); /* H is symmetric */
        double *row[3] = {A + first * u, A + (first + 1) * u, A + (first + 2) * u};
        double *slope = A + (first + 3) * u, *gap = A + (last + j) * u, moved[3], carried[3];
        for (int64_t col = 0; col < c->columns; col++) {
            for (int i = 0; i < 3; i++) moved[i] = dc[i][col];
            times(H, moved, carried);
            double by_slope = dot(bent, moved), by_gap = dot(n, moved);
            for (int i = 0; i < 3; i++) by_slope += n[i] * change[i][col];
            if (col < last) {
                for (int i = 0; i < 3; i++) row[i][col] = -f * carried[i];
                if (!touch->pinned) slope[col] = by_slope;
                gap[col] = by_gap;
            } else {
                double *to = b + col - last;
                int left = extras == 1; /* of the equations */
                for (int i = 0; i < 3; i++)
                    to[(first + i) * extras] = f * carried[i] + left * (f * n[i] - touch->force[i]);
                to[(first + 3) * extras] = touch->pinned ? 0 : -by_slope - left * touch->slope;
                to[(last + j) * extras] = -by_gap - left * touch->gap;
            }
        }
        for (int i = 0; i < 3; i++) row[i][first + i] += 1, row[i][last + j] = -n[i];
        if (touch->pinned) slope[first + 3] = 1;
        gap[last + j] = surface->softness;
    }
    return 1;
}

/* Solve A X = B in place for columns (n, m) of B, by elimination with row pivoting. */
static int eliminate(double *A, double *B, int64_t n, int64_t m) {
    for (int64_t i = 0; i < n; i++) {
        int64_t best = i;
        for (int64_t r = i + 1; r < n; r++)
            if (fabs(A[r * n + i]) > fabs(A[best * n + i])) best = r;
        if (!(fabs(A[best * n + i]) > 0)) return 0;
        for (int64_t col = i; best != i && col < n; col++) {
            double kept = A[i * n + col];
            A[i * n + col] = A[best * n + col], A[best * n + col] = kept;
        }
        for (int64_t col = 0; best != i && col < m; col++) {
            double kept = B[i * m + col];
            B[i * m + col] = B[best * m + col], B[best * m + col] = kept;
        }
        for (int64_t r = i + 1; r < n; r++) {
            double share = A[r * n + i] / A[i * n + i];
            if (share == 0) continue;
            for (int64_t col = i + 1; col < n; col++) A[r * n + col] -= share * A[i * n + col];
            for (int64_t col = 0; col < m; col++) B[r * m + col] -= share * B[i * m + col];
        }
    }
    for (int64_t i = n - 1; i >= 0; i--)
        for (int64_t c = 0; c < m; c++) {
            for (int64_t col = i + 1; col < n; col++) B[i * m + c] -= A[i * n + col] * B[col * m + c];
            B[i * m + c] /= A[i * n + i];
        }
    return 1;
}

/* Add a correction to the nodes, shortened, with the rest of it, so that nothing turns by more than
 * is allowed; return the largest turn. */
static double correct_nodes(const Problem *p, const Changes *c, double *x) {
    int64_t last = 3 + 4 * p->contacts;
    double largest = 0, to[MOST_STEPS + 1][6];
    for (int64_t i = 0; i <= p->steps; i++) {
        for (int r = 0; r < 6; r++) {
            to[i][r] = c->X[i][r][last];
            for (int64_t col = 0; col < last; col++) to[i][r] += c->X[i][r][col] * x[col];
        }
        double size = sqrt(dot(to[i], to[i]));
        if (!(size <= FARTHEST_TURN)) return INFINITY;
        largest = fmax(largest, size);
    }
    double share = fmin(1, LARGEST_TURN / largest);
    for (int64_t i = 0; i <= p->steps; i++) {
        for (int r = 0; r < 6; r++) to[i][r] *= share;
        turn_by(p->q + 4 * i, to[i]);
        for (int r = 0; r < 3; r++) p->m[3 * i + r] += to[i][3 + r];
    }
    for (int64_t i = 0; i < last + p->contacts; i++) x[i] *= share;
    return largest;
}

/* Move nodes after contacts have slid; return 0 if steps would get an invalid length. */
static int move_nodes(const Problem *p, const double *slides) {
    double h[MOST_STEPS];
    for (int64_t i = 0; i < p->steps; i++) {
        h[i] = p->at[i] - p->at[i + 1];
        for (int64_t j = 0; j < p->contacts; j++) h[i] += p->per_station[p->contacts * i + j] * slides[j];
        double longest = p->rigid[i] ? INFINITY : STRETCHED * p->longest[p->segment[i]];
        if (!(h[i] > 0 && h[i] <= longest)) return 0;
    }
    for (int64_t i = 0; i < p->steps; i++) p->at[i + 1] = p->at[i] - h[i];
    return 1;
}

/* Run Newton's method from a state, in place.  REMESH: contacts have left their ranges or steps no
 * longer fit; nodes and contacts are updated so far, and the mesh is unchanged. */
int64_t stiffopt_contact_correct(const Problem *p) {
    static _Thread_local Changes changes;
    double A[MOST_UNKNOWNS * MOST_UNKNOWNS], x[MOST_UNKNOWNS], previous = INFINITY;
    int64_t k = p->contacts, last = 3 + 4 * k;
    NEW_WORK(work);
    if (k > MOST_CONTACTS || p->steps > MOST_STEPS) return LOST;
    for (int iteration = 0; iteration < MOST_ITERATIONS; iteration++) {
        if (!linearise(&work, p, &changes, 1) || !assemble(&work, p, &changes, A, x)) return LOST;
        if (!eliminate(A, x, 3 + 5 * k, 1)) return LOST;
        double size = correct_nodes(p, &changes, x), slides[MOST_CONTACTS], slide = 0;
        if (!(size <= FARTHEST_TURN) || (iteration > 3 && size > previous)) return LOST;
        int inside = 1;
        for (int64_t j = 0; j < k; j++) {
            Touch *touch = p->touches + j;
            double own = fmin(fmax(x[3 + 4 * j + 3], -LARGEST_SLIDE), LARGEST_SLIDE);
            for (int i = 0; i < 3; i++) touch->force[i] += x[3 + 4 * j + i];
            touch->normal_force += x[last + j];
            touch->station += own, slides[j] = own, slide = fmax(slide, fabs(own));
            if (!touch->pinned && !(touch->start < touch->station && touch->station < touch->end)) inside = 0;
        }
        if (!inside || !move_nodes(p, slides)) return REMESH;
        if (size < LEAST_LEFT_TURN && slide < LEAST_LEFT_SLIDE) return CONVERGED;
        previous = fmax(size, LEAST_LEFT_TURN);
    }
    return LOST;
}

/* Compute changes (6 + contacts, 6) of an equilibrium along a force and moment on the tip, in base
 * axes: of the tip's place and turn, and of the normal forces. */
int64_t stiffopt_contact_tangent(const Problem *p, double *found) {
    static _Thread_local Changes changes;
    double A[MOST_UNKNOWNS * MOST_UNKNOWNS], x[MOST_UNKNOWNS * MOST_EXTRAS];
    int64_t k = p->contacts, last = 3 + 4 * k;
    NEW_WORK(work);
    if (!linearise(&work, p, &changes, 6) || !assemble(&work, p, &changes, A, x)) return 0;
    if (!eliminate(A, x, 3 + 5 * k, 6)) return 0;
    for (int r = 0; r < 6; r++)
        for (int e = 0; e < 6; e++) {
            const double *change = r < 3 ? changes.moves[0][r] : changes.X[0][r - 3];
            found[6 * r + e] = change[last + e];
            for (int64_t col = 0; col < last; col++) found[6 * r + e] += change[col] * x[6 * col + e];
        }
    memcpy(found + 36, x + 6 * last, (size_t)(6 * k) * sizeof(double));
    return 1;
}

/* Compute a point of the body at an arc length; return its step. */
static int64_t point_at(const Problem *p, double at, double *point) {
    int64_t i = 0;
    while (i + 1 < p->steps && at <= p->at[i + 1]) i++;
    double h = p->at[i] - p->at[i + 1], x = (p->at[i] - at) / h;
    for (int r = 0; r < 3; r++) {
        double start = p->position[3 * i + r], way = p->position[3 * i + 3 + r] - start;
        double first = -h * p->near[3 * i + r], last = -h * p->far[3 * i + r];
        point[r] =
            start + x * (first + x * (3 * way - 2 * first - last + x * (first + last - 2 * way)));
    }
    return i;
}

/* Compute points (count, 3) and radii (count) of the body at arc lengths. */
void stiffopt_contact_body(const Problem *p, int64_t count, const double *at, double *points,
                           double *radii) {
    for (int64_t k = 0; k < count; k++)
        radii[k] = p->radius[p->segment[point_at(p, at[k], points + 3 * k)]];
}

static void mix(double share, const double *a, const double *b, int count, double *to) {
    for (int i = 0; i < count; i++) to[i] = (1 - share) * a[i] + share * b[i];
}

/* Compute bodies (looks, count, 3) at shares of the way between two shapes on one mesh: turns and
 * ways from node to node change evenly. */
void stiffopt_contact_between(const Problem *first, const Problem *last, int64_t looks,
                              const double *shares, int64_t count, const double *at,
                              double *points) {
    const Problem *ends[2] = {first, last};
    double turns[2][MOST_STEPS][4], ways[2][MOST_STEPS][3], R[MOST_STEPS][9], r[MOST_STEPS + 1][3];
    double(*local)[2][3] = malloc((size_t)count * sizeof *local);
    int64_t N = first->steps, *step = malloc((size_t)count * sizeof *step);
    for (int e = 0; e < 2; e++) {
        for (int64_t k = 0; k < count; k++) {
            double x[3], Q[9];
            int64_t i = step[k] = point_at(ends[e], at[k], x);
            rotation(ends[e]->q + 4 * (i + 1), Q);
            for (int a = 0; a < 3; a++) x[a] -= ends[e]->position[3 * (i + 1) + a];
            transposed_times(Q, x, local[k][e]);
        }
        for (int64_t i = 0; i < N; i++) {
            const double *q = ends[e]->q + 4 * i, *base = q + 4, *x = ends[e]->position + 3 * i;
            double *turn = turns[e][i], way[3] = {x[0] - x[3], x[1] - x[4], x[2] - x[5]}, c[3];
            cross(base + 1, q + 1, c);
            turn[0] = base[0] * q[0] + dot(base + 1, q + 1);
            for (int a = 0; a < 3; a++) turn[1 + a] = base[0] * q[1 + a] - q[0] * base[1 + a] - c[a];
            for (int a = 3; a >= 0; a--) turn[a] *= turn[0] < 0 ? -1 : 1;
            rotation(base, R[0]), transposed_times(R[0], way, ways[e][i]);
        }
    }
    for (int64_t look = 0; look < looks; look++) {
        double q[4], turn[4], way[3], c[3], share = shares[look];
        memcpy(q, first->q + 4 * N, sizeof q), memset(r[N], 0, sizeof r[N]);
        for (int64_t i = N - 1; i >= 0; i--) {
            rotation(q, R[i]); /* of the node at the base's side */
            mix(share, ways[0][i], ways[1][i], 3, way), mix(share, turns[0][i], turns[1][i], 4, turn);
            times(R[i], way, c);
            for (int a = 0; a < 3; a++) r[i][a] = r[i + 1][a] + c[a];
            cross(q + 1, turn + 1, c);
            double real = q[0] * turn[0] - dot(q + 1, turn + 1);
            for (int a = 0; a < 3; a++) q[1 + a] = q[0] * turn[1 + a] + turn[0] * q[1 + a] + c[a];
            q[0] = real;
        }
        for (int64_t k = 0; k < count; k++) {
            double here[3], x[3];
            mix(share, local[k][0], local[k][1], 3, here), times(R[step[k]], here, x);
            for (int a = 0; a < 3; a++) points[3 * (look * count + k) + a] = r[step[k] + 1][a] + x[a];
        }
    }
    free(local), free(step);
}

/* Compute the distances (count) of points (count, 3) from a surface. */
void stiffopt_contact_distances(const Surface *surface, int64_t count, const double *points,
                                double *distances) {
    NEW_WORK(work);
    const double *piece;
    for (int64_t k = 0; k < count; k++)
        distances[k] = distance_from(&work, surface, points + 3 * k, &piece);
}

/* -- stability ------------------------------------------------------------------------------- */

/* Compute moment and force (6) at the start of a step, by turns and positions of its ends (12). */
static int wrench_at_start(const Problem *p, int64_t i, double *start) {
    const double *J = p->J + 90 * i;
    double by[36], R[9];
    for (int r = 0; r < 6; r++)
        for (int c = 0; c < 6; c++) by[6 * r + c] = J[9 * (3 + c) + r];
    if (p->rigid[i]) {
        double h = p->at[i] - p->at[i + 1];
        const double *C = p->compliance + 36 * p->segment[i];
        rotation(p->q + 4 * i, R);
        for (int half = 0; half < 2; half++) /* turns by moments, then displacements by forces */
            for (int r = 0; r < 3; r++)
                for (int c = 0; c < 3; c++) {
                    double sum = 0;
                    for (int a = 0; a < 3; a++)
                        for (int b = 0; b < 3; b++)
                            sum += R[3 * r + a] * C[6 * (a + 3 - 3 * half) + b + 3 - 3 * half] * R[3 * c + b];
                    by[6 * (r + 3 * half) + c + 3 * half] -= RIGID * h * sum;
                }
    }
    memset(start, 0, 72 * sizeof(double));
    for (int r = 0; r < 6; r++) {
        start[12 * r + 6 + r] = 1;
        for (int c = 0; c < 3; c++) start[12 * r + c] = -J[9 * c + r];
        if (r >= 3) start[12 * r + r] -= 1;
    }
    return eliminate(by, start, 6, 12);
}

/* Compute the change of the gap's slope at a contact by turns and positions of the nodes, 6 + 12
 * numbers from the node before its own; return the gap's second derivative along the arm. */
static double slope_change(const Problem *p, const Touch *touch, const double *starts, double *to) {
    const double *C = p->compliance + 36 * touch->segment, *n = touch->normal, *mean = touch->mean;
    int64_t node = touch->node;
    double R[9], bent[3], force[3], lf[3], lm[3], d[3], own[3], crossed[3], vector[3];
    memset(to, 0, 18 * sizeof(double));
    times(touch->curvature, mean, bent);
    for (int i = 0; i < 3; i++) to[9 + i] = bent[i];
    rotation(p->q + 4 * node, R);
    cross(mean, n, vector); /* n . (turn x mean) = turn . (mean x n) */
    for (int i = 0; i < 3; i++) to[6 + i] = vector[i];
    double bend = dot(mean, bent);
    if (touch->rigid) return bend;
    /* how n . t changes by forces and moments there: R C_vv R' n and R C_wv R' n */
    transposed_times(R, n, d);
    for (int i = 0; i < 3; i++) {
        lf[i] = lm[i] = 0;
        for (int b = 0; b < 3; b++) lf[i] += C[6 * i + b] * d[b], lm[i] += C[6 * (3 + i) + b] * d[b];
    }
    times(R, lf, own), times(R, lm, crossed);
    const double *moment = p->moment_far + 3 * node;
    for (int i = 0; i < 3; i++) force[i] = p->force_far[3 * node + i] + touch->force[i] / 2;
    /* own . (-turn x force) = turn . (own x force) */
    cross(own, force, vector);
    for (int i = 0; i < 3; i++) to[6 + i] += vector[i];
    cross(crossed, moment, vector);
    for (int i = 0; i < 3; i++) to[6 + i] += vector[i];
    /* by lengths: a step shorter than the contact, at a segment's end, would count too much */
    const double *near = starts + 72 * node;
    double share = node ? (p->at[node] - p->at[node + 1]) / (p->at[node - 1] - p->at[node + 1]) : 0.5;
    for (int c = 0; c < 12; c++)
        for (int i = 0; i < 3; i++)
            to[6 + c] += share * own[i] * near[12 * (3 + i) + c] + crossed[i] * near[12 * i + c];
    for (int c = 0; c < 12 && node > 0; c++)
        for (int i = 0; i < 3; i++) to[c] += (1 - share) * own[i] * (near - 72)[12 * (3 + i) + c];
    double local[6], xi[6], slope[6], a[3], b[3], w[3];
    transposed_times(R, force, local), transposed_times(R, moment, local + 3);
    transposed_times(R, p->weight + 3 * touch->segment, w); /* reduces the force towards the tip */
    for (int i = 0; i < 6; i++) {
        xi[i] = p->strain[6 * touch->segment + i];
        for (int c = 0; c < 6; c++) xi[i] += C[6 * c + i] * local[c];
    }
    cross(local, xi + 3, slope), cross(local, xi, a), cross(local + 3, xi + 3, b);
    for (int i = 0; i < 3; i++) slope[i] -= w[i], slope[3 + i] = a[i] + b[i];
    cross(xi + 3, xi, a);
    for (int i = 0; i < 3; i++) {
        for (int c = 0; c < 6; c++) a[i] += C[6 * c + i] * slope[c];
        bend += d[i] * a[i];
    }
    return bend;
}

/* Whether a symmetric matrix is positive definite, its rows `wide` numbers apart. */
static int is_definite(double *K, int64_t n, int64_t wide) {
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j <= i; j++) {
            double sum = K[i * wide + j];
            for (int64_t c = 0; c < j; c++) sum -= K[i * wide + c] * K[j * wide + c];
            if (j < i) K[i * wide + j] = sum / K[j * wide + j];
            else if (!(sum > 0)) return 0;
            else K[i * wide + i] = sqrt(sum);
        }
    return 1;
}

/* Whether the result of `stiffopt_contact_correct` under dead forces is a minimum of the energy;
 * memory: K ((6 steps + 6)^2) and starts (72 steps). */
int64_t stiffopt_contact_is_stable(const Problem *p, double *K, double *starts) {
    int64_t N = p->steps, n = 6 * N, wide = n + 6;
    memset(K, 0, (size_t)(wide * wide) * sizeof(double));
    for (int64_t i = 0; i < N; i++) {
        double *start = starts + 72 * i, *J = p->J + 90 * i;
        if (!wrench_at_start(p, i, start)) return 0;
        for (int c = 0; c < 12; c++)
            for (int r = 0; r < 6; r++) {
                K[(6 * i + r) * wide + 6 * i + c] += start[12 * r + c];
                double end = r < 3 ? (c < 3 ? J[9 * c + 6 + r] : 0) : start[12 * r + c];
                for (int b = 0; b < 6 && r < 3; b++) end += J[9 * (3 + b) + 6 + r] * start[12 * b + c];
                K[(6 * i + 6 + r) * wide + 6 * i + c] -= end;
            }
    }
    for (int64_t j = 0; j < p->contacts; j++) {
        const Touch *touch = p->touches + j;
        double f = touch->normal_force, softness = p->surfaces[touch->surface].softness, slope[18];
        double held = softness > 0 ? 1 / softness : HELD;
        int64_t at = 6 * touch->node + 3;
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++)
                K[(at + r) * wide + at + c] += held * touch->normal[r] * touch->normal[c] -
                                               f * touch->curvature[3 * r + c];
        if (touch->pinned) continue;
        double bend = slope_change(p, touch, starts, slope);
        if (bend < -FLATTEST && f > 0) return 0; /* the body enters on both sides */
        bend = fmax(bend, FLATTEST);
        for (int r = touch->node ? 0 : 6; r < 18; r++)
            for (int c = touch->node ? 0 : 6; c < 18; c++)
                K[(at - 9 + r) * wide + at - 9 + c] += f / bend * slope[r] * slope[c];
    }
    for (int64_t r = 0; r < n; r++)
        for (int64_t c = 0; c <= r; c++) {
            double scale = (r % 6 < 3 ? 1 / p->length : 1) * (c % 6 < 3 ? 1 / p->length : 1);
            K[r * wide + c] = scale * (K[r * wide + c] + K[c * wide + r]) / 2;
        }
    return is_definite(K, n, wide);
}
