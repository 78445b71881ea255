/* The rod under gravity and loads, integrated from its tip to its base.
 *
 * The state is y = (q, m), orientation and moment (7), and position r, which does not feed back.
 * The equations and their derivatives are generated (`stiffopt.model.rod`).  This file has the
 * steps of Cooper and Verner's Runge-Kutta method of order eight, and propagates along them:
 *
 *   newton_step    changes per turn of the tip, and the defects of the lifted Newton method; with
 *                  those per moment at the tip whether it is stable (Jacobi's condition),
 *   linearise      changes per turn, added wrench and pressures: pose, Jacobian and compliance,
 *   add_curvature  adjoint of a change: derivatives of the compliance by the pressures.
 *
 * The notes of each piece (`Carried.notes`) allow interpolation anywhere on the arm, see body.h.
 *
 * A direction is one column of changes, of eight numbers (y and a zero); columns are stored one
 * after the other.  A pressure is propagated only from its own segment towards the base.
 */
#ifndef STIFFOPT_ROD_H
#define STIFFOPT_ROD_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "work.h"

#define STAGES 11
#define TURNS 3
#define WRENCHES 6
#define FIRST (TURNS + WRENCHES) /* directions before the pressures */
#define WITH_FORCE (TURNS + 3)   /* the first directions, along which the force changes */
#define ROD_INLINE static inline __attribute__((always_inline))

/* Compile loops over directions also for wider registers, for processors that have them; the
 * results are the same. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define ROD_CLONES __attribute__((target_clones("avx2", "default"), optimize("O3")))
#else
#define ROD_CLONES
#endif

/* A piece of arm: soft, or rigid (kind -1). */
typedef struct {
    int64_t kind;
    int64_t parts, slopes;     /* where its section begins in a and da */
    int64_t channel, channels; /* its pressures */
    int64_t steps;
    double length; /* of a step, or of a rigid piece */
    double mass;   /* per length */
} RodPiece;

typedef struct {
    int64_t n, pieces, steps, parts, slopes;
    const RodPiece *piece; /* from the tip to the base */
    const double *numbers; /* of the arm, see `stiffopt.model.layout` */
    double gravity[3], load[12], tip_mass;
    const double *hanging; /* state (rod_state_size) of the unpressurised arm under its weight */
} Rod;

/* The condition of an equilibrium: pressures (Pa), load and gravity. */
typedef struct {
    const double *pressures;
    double load[12], gravity[3];
} Condition;

/* Size of a state: its pressures (n), the tip's quaternion (4), (q, m) after each step (7). */
static int64_t rod_state_size(const Rod *rod) { return rod->n + 4 + 7 * rod->steps; }

/* Row i of the method's table: coefficients of earlier stages, and its place in the step. */
typedef struct {
    double at;
    int count, from[6];
    double a[6];
} Row;

#define S 4.58257569495584000658804719372800848898445657676797
static const Row TABLE[STAGES] = {
    {0, 0, {0}, {0}},
    {1. / 2, 1, {0}, {1. / 2}},
    {1. / 2, 2, {0, 1}, {1. / 4, 1. / 4}},
    {(7 + S) / 14, 3, {0, 1, 2}, {1. / 7, (-7 - 3 * S) / 98, (21 + 5 * S) / 49}},
    {(7 + S) / 14, 3, {0, 2, 3}, {(11 + S) / 84, (18 + 4 * S) / 63, (21 - S) / 252}},
    {1. / 2, 4, {0, 2, 3, 4},
     {(5 + S) / 48, (9 + S) / 36, (-231 + 14 * S) / 360, (63 - 7 * S) / 80}},
    {(7 - S) / 14, 5, {0, 2, 3, 4, 5},
     {(10 - S) / 42, (-432 + 92 * S) / 315, (633 - 145 * S) / 90, (-504 + 115 * S) / 70,
      (63 - 13 * S) / 35}},
    {(7 - S) / 14, 4, {0, 4, 5, 6}, {1. / 14, (14 - 3 * S) / 126, (13 - 3 * S) / 63, 1. / 9}},
    {1. / 2, 5, {0, 4, 5, 6, 7},
     {1. / 32, (91 - 21 * S) / 576, 11. / 72, (-385 - 75 * S) / 1152, (63 + 13 * S) / 128}},
    {(7 + S) / 14, 6, {0, 4, 5, 6, 7, 8},
     {1. / 14, 1. / 9, (-733 - 147 * S) / 2205, (515 + 111 * S) / 504, (-51 - 11 * S) / 56,
      (132 + 28 * S) / 245}},
    {1, 6, {4, 5, 6, 7, 8, 9},
     {(-42 + 7 * S) / 18, (-18 + 28 * S) / 45, (-273 - 53 * S) / 72, (301 + 53 * S) / 72,
      (28 - 28 * S) / 45, (49 - 7 * S) / 18}},
};
static const double WEIGHT[STAGES] = {1. / 20, 0, 0, 0, 0, 0, 0,
                                      49. / 180, 16. / 45, 49. / 180, 1. / 20};
#undef S

/* An integration method: rows, and weights of their slopes. */
typedef struct {
    int stages;
    const Row *row;
    const double *weight;
} Method;

static const Method EIGHTH_ORDER = {STAGES, TABLE, WEIGHT};

/* Runge-Kutta of order four, for Newton's first steps, which are larger than its errors. */
static const Method FOURTH_ORDER = {
    4,
    (const Row[4]){{0, 0, {0}, {0}}, {1. / 2, 1, {0}, {1. / 2}}, {1. / 2, 1, {1}, {1. / 2}},
                   {1, 1, {2}, {1}}},
    (const double[4]){1. / 6, 1. / 3, 1. / 3, 1. / 6}};

/* -- generated functions, by kind of section ------------------------------------------------ */

/* Kinds that the layout does not have are never called. */
#ifndef NEWTON1_N_IN
#define newton1 newton0
#define slope1 slope0
#define linear1 linear0
#define adjoint1 adjoint0
#endif
#ifndef NEWTON2_N_IN
#define newton2 newton0
#define slope2 slope0
#define linear2 linear0
#define adjoint2 adjoint0
#endif
#ifndef NEWTON3_N_IN
#define newton3 newton0
#define slope3 slope0
#define linear3 linear0
#define adjoint3 adjoint0
#endif

#define SECTION_FUNCTION(name)                                                   \
    static int section_##name(const Work *work, int64_t kind) {                  \
        switch (kind) {                                                          \
        case 1: return name##1(work->arg, work->res, work->iw, work->w, 0);      \
        case 2: return name##2(work->arg, work->res, work->iw, work->w, 0);      \
        case 3: return name##3(work->arg, work->res, work->iw, work->w, 0);      \
        default: return name##0(work->arg, work->res, work->iw, work->w, 0);     \
        }                                                                        \
    }

SECTION_FUNCTION(newton)
SECTION_FUNCTION(linear)
SECTION_FUNCTION(slope)
#ifdef RIGID_ADJOINT_N_IN /* a library may do without add_curvature */
SECTION_FUNCTION(adjoint)
#endif

/* -- small algebra -------------------------------------------------------------------------- */

static int invert_3x3(const double *a, double *b) { /* by rows or by columns, alike */
    b[0] = a[4] * a[8] - a[5] * a[7], b[1] = a[2] * a[7] - a[1] * a[8];
    b[2] = a[1] * a[5] - a[2] * a[4], b[3] = a[5] * a[6] - a[3] * a[8];
    b[4] = a[0] * a[8] - a[2] * a[6], b[5] = a[2] * a[3] - a[0] * a[5];
    b[6] = a[3] * a[7] - a[4] * a[6], b[7] = a[1] * a[6] - a[0] * a[7];
    b[8] = a[0] * a[4] - a[1] * a[3];
    double determinant = a[0] * b[0] + a[1] * b[3] + a[2] * b[6];
    for (int i = 0; i < 9; i++) b[i] /= determinant;
    return isfinite(1 / determinant) && isfinite(determinant);
}

/* C = A B of (3, 3), row by row. */
static void multiply_3x3(const double *A, const double *B, double *C) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double sum = 0;
            for (int k = 0; k < 3; k++) sum += A[3 * i + k] * B[3 * k + j];
            C[3 * i + j] = sum;
        }
}

/* Turn a quaternion by a small rotation vector in body axes, as `stiffopt.model.equilibrium` does.
 */
static void turn_quaternion(double *q, const double *turn) {
    double x = turn[0] / 2, y = turn[1] / 2, z = turn[2] / 2;
    double p[4] = {q[0] - q[1] * x - q[2] * y - q[3] * z, q[0] * x + q[1] + q[2] * z - q[3] * y,
                   q[0] * y - q[1] * z + q[2] + q[3] * x, q[0] * z + q[1] * y - q[2] * x + q[3]};
    double size = sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] + p[3] * p[3]);
    for (int i = 0; i < 4; i++) q[i] = p[i] / size;
}

/* Convert changes of a quaternion (`count` columns, eight apart) to rotation vectors in body axes,
 * a matrix (3, count) stored by rows. */
static void turns_between(const double *q, const double *dq, int count, double *turns) {
    double w = q[0], x = q[1], y = q[2], z = q[3];
    for (int k = 0; k < count; k++, dq += 8) {
        turns[k] = 2 * (-x * dq[0] + w * dq[1] + z * dq[2] - y * dq[3]);
        turns[count + k] = 2 * (-y * dq[0] - z * dq[1] + w * dq[2] + x * dq[3]);
        turns[2 * count + k] = 2 * (-z * dq[0] + y * dq[1] - x * dq[2] + w * dq[3]);
    }
}

/* -- steps ---------------------------------------------------------------------------------- */

#define SLOT (8 + 4 + FIRST * 8) /* record of a stage for the adjoint: y, n, first directions */

/* State and changes, propagated from the tip to the base. */
typedef struct {
    double y[8], r[4], n[4];
    int64_t directions;   /* their number */
    int64_t forced;       /* number of the first ones, along which the force changes */
    double *Y, *X;        /* changes of y (directions, 8) and r (directions, 4) */
    const double *dn;     /* (forced, 3) */
    double *trace;        /* output: records of stages, or NULL */
    double *notes;        /* output: notes of steps, or NULL */
    int64_t noted;        /* largest number of directions of a note */
} Carried;

/* The note of a step or a rigid piece has six blocks of (1 + noted) columns of 12 numbers: the
 * value, then the directions, each (q, m, 0, r, 0).  The first block is the start, the others are
 * the slopes at the stages with a weight, the Lobatto points.  For a rigid piece only the second is
 * used; it holds the whole change. */
#define BLOCKS 6

static int64_t block_size(int64_t noted) { return 12 * (1 + noted); }

/* Address of the next note. */
static double *next_note(double *notes, int64_t noted) { return notes + BLOCKS * block_size(noted); }

static void note(double *block, int64_t directions, const double *y, const double *r,
                 const double *Y, const double *X) {
    memcpy(block, y, 8 * sizeof(double)), memcpy(block + 8, r, 4 * sizeof(double));
    for (int64_t d = 0; d < directions; d++) {
        memcpy(block + 12 + 12 * d, Y + 8 * d, 8 * sizeof(double));
        memcpy(block + 20 + 12 * d, X + 4 * d, 4 * sizeof(double));
    }
}

/* A vector of four numbers, which compilers map to the processor's registers. */
typedef double Four __attribute__((vector_size(32), aligned(8), may_alias));

ROD_INLINE Four four(const double *from) { return *(const Four *)from; }
ROD_INLINE void put(double *to, Four value) { *(Four *)to = value; }

/* Compute changes of slopes: K = G y + Gn dn for each direction, plus the columns of Gp for the
 * last `own` ones.  Matrices are stored by columns of 8 rows or, with position, 12; the position's
 * part of K goes to `moved` and, times a share (if not zero), is added to X. */
ROD_INLINE void change_slopes(int rows, const double *restrict G, const double *restrict Gn,
                              const double *restrict Gp, int64_t own, const Carried *c,
                              const double *restrict Y, double *restrict K,
                              double *restrict moved, double share) {
    double *restrict X = c->X;
    int64_t D = c->directions;
    int position = rows == 12 && share != 0;
    for (int64_t d = 0; d < D; d++, Y += 8, K += 8) {
        Four a = four(G) * Y[0], b = four(G + 4) * Y[0], r = {0, 0, 0, 0};
        if (position) r = four(G + 8) * Y[0];
        for (int j = 1; j < 7; j++) {
            a += four(G + j * rows) * Y[j], b += four(G + j * rows + 4) * Y[j];
            if (position) r += four(G + j * rows + 8) * Y[j];
        }
        if (d < c->forced) {
            const double *dn = c->dn + 3 * d;
            for (int j = 0; j < 3; j++) {
                a += four(Gn + j * rows) * dn[j], b += four(Gn + j * rows + 4) * dn[j];
                if (position) r += four(Gn + j * rows + 8) * dn[j];
            }
        }
        if (d >= D - own) {
            const double *column = Gp + rows * (d - D + own);
            a += four(column), b += four(column + 4);
            if (position) r += four(column + 8);
        }
        put(K, a), put(K + 4, b);
        if (position) put(moved + 4 * d, r), put(X + 4 * d, four(X + 4 * d) + share * r);
    }
}

/* to = from + h (a[0] K[0] + a[1] K[1] + ...) for rows of numbers, a multiple of four. */
ROD_INLINE void combine(int64_t numbers, const double *restrict from, int count, const double *a,
                        const double *const *K, double *restrict to) {
    for (int64_t k = 0; k < numbers; k += 4) {
        Four sum = four(from + k);
        for (int j = 0; j < count; j++) sum += a[j] * four(K[j] + k);
        put(to + k, sum);
    }
}

/* Take one step; with `rows` 12 including position, then without directions if `da` is NULL.  The
 * last `own` directions are the section's own pressures. */
ROD_INLINE int rod_step(const Work *work, const Method *method, const RodPiece *piece,
                        const double *a, const double *da, const double *weight, int rows,
                        int64_t own, Carried *c) {
    double h = piece->length;
    int64_t D = c->directions;
    double slope[STAGES][12], G[12 * 7], Gn[12 * 3], Gp[12 * (piece->channels + 1)];
    double y[8], n[3], Y[D * 8 + 4], change[STAGES][D * 8 + 4], moved[D * 4 + 4], share[6];
    const double *slopes[6], *changes[6];
    double *block = c->notes;
    if (block) {
        note(block, D, c->y, c->r, c->Y, c->X);
        block += block_size(c->noted), c->notes = next_note(c->notes, c->noted);
    }
    for (int i = 0; i < method->stages; i++) {
        const Row *row = method->row + i;
        for (int j = 0; j < row->count; j++) {
            share[j] = h * row->a[j];
            slopes[j] = slope[row->from[j]], changes[j] = change[row->from[j]];
        }
        combine(8, c->y, row->count, share, slopes, y);
        combine(8 * D, c->Y, row->count, share, changes, Y);
        for (int k = 0; k < 3; k++) n[k] = c->n[k] + weight[k] * (h * row->at);
        if (c->trace) {
            memcpy(c->trace, y, sizeof y);
            memcpy(c->trace + 8, n, sizeof n);
            memcpy(c->trace + 12, Y, FIRST * 8 * sizeof(double));
            c->trace += SLOT;
        }
        work->arg[0] = y, work->arg[1] = n, work->arg[2] = weight, work->arg[3] = a;
        work->arg[4] = da;
        work->res[0] = slope[i], work->res[1] = G, work->res[2] = Gn, work->res[3] = Gp;
        if (rows == 8   ? section_newton(work, piece->kind)
            : da == NULL ? section_slope(work, piece->kind)
                         : section_linear(work, piece->kind))
            return 0;
        double by = h * method->weight[i];
        change_slopes(rows, G, Gn, Gp, own, c, Y, change[i], moved, by);
        if (rows == 8 || by == 0) continue;
        for (int j = 0; j < 4; j++) c->r[j] += by * slope[i][8 + j];
        if (block) {
            note(block, D, slope[i], slope[i] + 8, change[i], moved);
            block += block_size(c->noted);
        }
    }
    int count = 0;
    for (int i = 0; i < method->stages; i++) {
        if (method->weight[i] == 0) continue;
        share[count] = h * method->weight[i], slopes[count] = slope[i], changes[count++] = change[i];
    }
    combine(8, c->y, count, share, slopes, y);
    combine(8 * D, c->Y, count, share, changes, Y);
    memcpy(c->y, y, sizeof y);
    memcpy(c->Y, Y, (size_t)D * 8 * sizeof(double));
    for (int k = 0; k < 3; k++) c->n[k] += weight[k] * h;
    return 1;
}

ROD_CLONES static int lean_step(const Work *work, const Method *method, const RodPiece *piece,
                                const double *a, const double *weight, Carried *c) {
    return rod_step(work, method, piece, a, NULL, weight, 8, 0, c);
}

ROD_CLONES static int long_step(const Work *work, const RodPiece *piece, const double *a,
                                const double *da, const double *weight, int64_t own, Carried *c) {
    return rod_step(work, &EIGHTH_ORDER, piece, a, da, weight, 12, own, c);
}

/* Take a step without directions. */
static int plain_step(const Work *work, const RodPiece *piece, const double *a,
                      const double *weight, Carried *c) {
    return rod_step(work, &EIGHTH_ORDER, piece, a, NULL, weight, 12, 0, c);
}

/* Cross a rigid piece. */
static int rigid_stretch(const Work *work, const RodPiece *piece, int rows, Carried *c) {
    int64_t D = c->directions;
    double gain[12], G[12 * 7], Gn[12 * 3], change[D * 8 + 4], none[D * 4 + 4], moved[D * 4 + 4];
    if (c->trace) {
        memcpy(c->trace, c->y, sizeof c->y);
        memcpy(c->trace + 8, c->n, 3 * sizeof(double));
        memcpy(c->trace + 12, c->Y, FIRST * 8 * sizeof(double));
        c->trace += SLOT;
    }
    work->arg[0] = c->y, work->arg[1] = c->n, work->arg[2] = &piece->length;
    work->res[0] = gain, work->res[1] = G, work->res[2] = Gn;
    if (rigid(work->arg, work->res, work->iw, work->w, 0)) return 0;
    if (rows == 8) c->X = none;
    memset(none, 0, sizeof none);
    if (c->notes) note(c->notes, D, c->y, c->r, c->Y, c->X);
    change_slopes(12, G, Gn, NULL, 0, c, c->Y, change, moved, 1);
    if (c->notes) {
        note(c->notes + block_size(c->noted), D, gain, gain + 8, change, moved);
        c->notes = next_note(c->notes, c->noted);
    }
    for (int64_t k = 0; k < 8 * D; k++) c->Y[k] += change[k];
    for (int j = 0; j < 8; j++) c->y[j] += gain[j];
    for (int j = 0; j < 4; j++) c->r[j] += gain[8 + j];
    return 1;
}

/* Compute the sections at a condition: a (parts) and its derivatives (slopes). */
static int sections_at(const Work *work, const Rod *rod, const Condition *at, double *a,
                       double *da) {
    work->arg[0] = at->pressures, work->arg[1] = rod->numbers, work->res[0] = a, work->res[1] = da;
    return !sections(work->arg, work->res, work->iw, work->w, 0);
}

/* Start propagation at a tip of orientation q; the first directions turn it. */
static int start_at_tip(const Work *work, const Rod *rod, const Condition *at, const double *q,
                        double *dn, double *R, Carried *c) {
    double weight[3], dy[8 * 3];
    for (int i = 0; i < 3; i++) weight[i] = rod->tip_mass * at->gravity[i];
    memset(c->r, 0, sizeof c->r), memset(c->y, 0, sizeof c->y), c->n[3] = 0;
    work->arg[0] = q, work->arg[1] = at->load, work->arg[2] = weight;
    work->res[0] = c->y, work->res[1] = c->n, work->res[2] = dy, work->res[3] = dn;
    work->res[4] = R;
    if (tip(work->arg, work->res, work->iw, work->w, 0)) return 0;
    memset(c->Y, 0, (size_t)c->directions * 8 * sizeof(double));
    memcpy(c->Y, dy, sizeof dy);
    c->dn = dn;
    const double *f = at->load + 6;
    c->forced = f[0] != 0 || f[1] != 0 || f[2] != 0 ? TURNS : 0;
    c->trace = c->notes = NULL;
    return 1;
}

static void weight_of(const RodPiece *piece, const Condition *at, double *weight) {
    for (int i = 0; i < 3; i++) weight[i] = piece->mass * at->gravity[i];
}

/* -- equilibrium ---------------------------------------------------------------------------- */

/* Whether a symmetric matrix (3, 3) is positive definite. */
static int is_positive(const double *A) {
    double minor = A[0] * A[4] - A[1] * A[3];
    double whole = A[0] * (A[4] * A[8] - A[5] * A[7]) - A[1] * (A[3] * A[8] - A[5] * A[6]) +
                   A[2] * (A[3] * A[7] - A[4] * A[6]);
    return A[0] > 0 && minor > 0 && whole > 0;
}

/* Whether an eigenvalue of a matrix (3, 3) has real part <= -|imaginary part|. */
static int turns_back(const double *A) {
    double b = -(A[0] + A[4] + A[8]);
    double c = A[0] * A[4] - A[1] * A[3] + A[0] * A[8] - A[2] * A[6] + A[4] * A[8] - A[5] * A[7];
    double d = -(A[0] * (A[4] * A[8] - A[5] * A[7]) - A[1] * (A[3] * A[8] - A[5] * A[6]) +
                 A[2] * (A[3] * A[7] - A[4] * A[6]));
    /* the root of x^3 + b x^2 + c x + d that is farthest from the turning points: bisection */
    double far = 1 + fmax(fabs(b), fmax(fabs(c), fabs(d))), low = -far, high = far;
    for (int i = 0; i < 200 && high - low > 1e-15 * far; i++) {
        double x = (low + high) / 2;
        if (((x + b) * x + c) * x + d > 0)
            high = x;
        else
            low = x;
    }
    double root = (low + high) / 2;
    if (root <= 0) return 1;
    double p = b + root, q = c + root * p, square = p * p / 4 - q; /* x^2 + p x + q */
    if (square < 0) return -p / 2 <= -sqrt(-square);
    return -p / 2 - sqrt(square) <= 0;
}

/* Whether the arm between a state y and the tip is stable, from the changes of y per turn of the
 * tip (3) and per moment at it (3), as `Equilibrium.is_stable`; R of the tip is stored by columns.
 */
static int is_stable_to(const double *y, const double *by_turn, const double *by_moment,
                        const double *R, int conservative) {
    double per_turn[9], per_moment[9], inverse[9], here[9], turned[9], block[9], symmetric[9];
    turns_between(y, by_turn, 3, per_turn);
    turns_between(y, by_moment, 3, per_moment);
    if (!invert_3x3(per_turn, inverse)) return 0;
    if (!conservative) return 1;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) turned[3 * i + j] = R[3 * j + i];
    multiply_3x3(inverse, per_moment, here);
    multiply_3x3(here, turned, block);
    for (int s = 0; s < 3; s++)
        for (int t = 0; t < 3; t++)
            symmetric[3 * s + t] = -(block[3 * s + t] + block[3 * t + s]) / 2;
    return is_positive(symmetric);
}

/* Take one step of the lifted Newton method (`stiffopt.model.equilibrium`) on a state, in place;
 * return the largest turn of the tip or a state in rad, or NaN.  Unless stable is NULL, set it to
 * whether the state was stable, provided that it was an equilibrium. */
static double newton_step(const Work *work, const Rod *rod, const Condition *at, const double *a,
                          const Method *method, double *state, int *stable) {
    double *q = state + rod->n, *states = q + 4, *lifted = states;
    double Y[7 * 8], dn[9], R[9], changes[rod->steps * 4 * 8 + 1], *met = changes;
    Carried c = {.directions = stable ? 7 : 4, .Y = Y};
    int conservative = 1;
    if (stable) *stable = 1;
    for (int i = 3; i < 12; i++) conservative = conservative && at->load[i] == 0;
    if (!start_at_tip(work, rod, at, q, dn, R, &c)) return NAN;
    for (int i = 0; stable && i < 3; i++) Y[8 * (4 + i) + 4 + i] = 1;
    for (int64_t k = 0; k < rod->pieces; k++) {
        const RodPiece *piece = rod->piece + k;
        if (piece->kind < 0) {
            if (!rigid_stretch(work, piece, 8, &c)) return NAN;
            continue;
        }
        double weight[3];
        weight_of(piece, at, weight);
        for (int64_t i = 0; i < piece->steps; i++, lifted += 7, met += 32) {
            if (!lean_step(work, method, piece, a + piece->parts, weight, &c)) return NAN;
            for (int j = 0; j < 7; j++) Y[24 + j] += c.y[j] - lifted[j], c.y[j] = lifted[j];
            memcpy(met, Y, 32 * sizeof(double));
            if (stable) *stable = *stable && is_stable_to(c.y, Y, Y + 32, R, conservative);
        }
    }
    if (stable && !conservative) {
        double per_turn[9], base_turn[9];
        turns_between(c.y, Y, 3, per_turn);
        multiply_3x3(per_turn, R, base_turn);
        for (int i = 0; i < 9; i++) *stable = *stable && isfinite(base_turn[i]);
        *stable = *stable && !turns_back(base_turn);
    }
    double per_turn[9], inverse[9], turn[3];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) per_turn[3 * i + j] = Y[8 * j + 1 + i];
    if (!invert_3x3(per_turn, inverse)) return NAN;
    for (int i = 0; i < 3; i++) {
        turn[i] = 0;
        for (int j = 0; j < 3; j++) turn[i] -= inverse[3 * i + j] * (c.y[1 + j] + Y[24 + 1 + j]);
    }
    double most = sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]);
    for (int64_t k = 0; k < rod->steps; k++, states += 7) {
        const double *by = changes + 32 * k;
        double square = 0;
        for (int j = 0; j < 7; j++) {
            double move = by[24 + j];
            for (int t = 0; t < 3; t++) move += by[8 * t + j] * turn[t];
            states[j] += move;
            if (j < 4) square += move * move;
        }
        if (!(2 * sqrt(square) <= most)) most = 2 * sqrt(square);
    }
    turn_quaternion(q, turn);
    return most;
}

#define QUADRATIC 1e-6 /* rad; after such a step the error is 1e-12, by quadratic convergence */
#define NEARLY 1e-3    /* rad; after such a step the next is probably the last */
#define ROUGHLY 0.03   /* rad; larger steps are integrated coarsely, with errors below this */

/* Run Newton's method from a nearby or a `far` state, as `Equilibrium.correct`, to a stable
 * equilibrium if `stable` is not 0; after a failure the state is invalid. */
static int correct(const Work *work, const Rod *rod, const Condition *at, const double *a, int far,
                   int stable, double *state) {
    double before = 1, noise = QUADRATIC;
    for (int i = 0; i < 12; i++) {
        int coarse = before > ROUGHLY && (i > 0 || far), judged = stable && before <= NEARLY;
        int holds = 1;
        double size = newton_step(work, rod, at, a, coarse ? &FOURTH_ORDER : &EIGHTH_ORDER, state,
                                  judged ? &holds : NULL);
        if (!(size <= fmax(i < 2 ? before : 0.5 * before, noise))) return 0;
        if (size < QUADRATIC && !coarse && judged == stable) {
            memcpy(state, at->pressures, (size_t)rod->n * sizeof(double));
            return holds;
        }
        before = size, noise = coarse ? ROUGHLY : QUADRATIC;
    }
    return 0;
}

#define SHORTEST_FROM_REST 1e-3
#define SHORTEST_NEARBY 0.1

/* Follow the equilibrium from one condition to another, as `Equilibrium.follow`; set the state to
 * the last one found and return its share of the path. */
static double follow(const Work *work, const Rod *rod, const Condition *start, const Condition *end,
                     double shortest, int stable, double *state) {
    int64_t size = rod_state_size(rod);
    double trial[size], p[rod->n], a[rod->parts], da[rod->slopes];
    double share = 0, step = 1;
    int halved = 0;
    while (share < 1) {
        double to = fmin(1, share + step);
        Condition at = {.pressures = p};
        for (int64_t i = 0; i < rod->n; i++)
            p[i] = to < 1 ? (1 - to) * start->pressures[i] + to * end->pressures[i]
                          : end->pressures[i];
        for (int i = 0; i < 12; i++) at.load[i] = (1 - to) * start->load[i] + to * end->load[i];
        for (int i = 0; i < 3; i++)
            at.gravity[i] = (1 - to) * start->gravity[i] + to * end->gravity[i];
        memcpy(trial, state, sizeof trial);
        if (sections_at(work, rod, &at, a, da) &&
            correct(work, rod, &at, a, shortest < SHORTEST_NEARBY, stable, trial)) {
            memcpy(state, trial, sizeof trial);
            share = to;
            if (!halved) step *= 2;
            halved = 0;
        } else {
            step /= 2, halved = 1;
            if (step < shortest) return share;
        }
    }
    return 1;
}

/* Find the state of the unpressurised arm under its weight; return 0 if it falls over. */
static int hang(const Work *work, const Rod *rod, double *state) {
    double none[rod->n];
    memset(none, 0, sizeof none);
    memset(state, 0, (size_t)rod_state_size(rod) * sizeof(double));
    state[rod->n] = 1;
    for (int64_t k = 0; k < rod->steps; k++) state[rod->n + 4 + 7 * k] = 1;
    Condition straight = {.pressures = none}, weighted = {.pressures = none};
    memcpy(weighted.gravity, rod->gravity, sizeof weighted.gravity);
    return follow(work, rod, &straight, &weighted, SHORTEST_FROM_REST, 1, state) == 1;
}

static Condition condition_of(const Rod *rod, const double *pressures) {
    Condition at = {.pressures = pressures};
    memcpy(at.load, rod->load, sizeof at.load);
    memcpy(at.gravity, rod->gravity, sizeof at.gravity);
    return at;
}

/* Find the stable equilibrium reached from rest, as `Equilibrium.settle`; return 0 without one. */
static int settle(const Work *work, const Rod *rod, const double *pressures, double *state) {
    double none[rod->n];
    memset(none, 0, sizeof none);
    Condition start = {.pressures = none}, end = condition_of(rod, pressures);
    memcpy(start.gravity, rod->gravity, sizeof start.gravity);
    memcpy(state, rod->hanging, (size_t)rod_state_size(rod) * sizeof(double));
    return follow(work, rod, &start, &end, SHORTEST_FROM_REST, 1, state) == 1;
}

/* Move a state to the equilibrium at nearby pressures; to a stable one if `stable` is not 0. */
static int settle_nearby(const Work *work, const Rod *rod, const double *pressures, int stable,
                         double *state) {
    double from[rod->n];
    memcpy(from, state, sizeof from);
    if (!memcmp(from, pressures, sizeof from)) return 1;
    Condition start = condition_of(rod, from), end = condition_of(rod, pressures);
    return follow(work, rod, &start, &end, SHORTEST_NEARBY, stable, state) == 1;
}

/* Compute the tip's pose (12) at a state: position, rotation by columns; unless `notes` is NULL,
 * also the notes of all steps, without directions. */
static int tip_pose(const Work *work, const Rod *rod, const double *state, double *pose,
                    double *notes) {
    double dn[9], Y[TURNS * 8], a[rod->parts], da[rod->slopes];
    Condition at = condition_of(rod, state);
    Carried c = {.directions = TURNS, .Y = Y};
    if (!sections_at(work, rod, &at, a, da)) return 0;
    if (!start_at_tip(work, rod, &at, state + rod->n, dn, pose + 3, &c)) return 0;
    c.directions = c.forced = 0, c.notes = notes;
    for (int64_t k = 0; k < rod->pieces; k++) {
        const RodPiece *piece = rod->piece + k;
        if (piece->kind < 0) {
            if (!rigid_stretch(work, piece, 12, &c)) return 0;
            continue;
        }
        double weight[3];
        weight_of(piece, &at, weight);
        for (int64_t i = 0; i < piece->steps; i++)
            if (!plain_step(work, piece, a + piece->parts, weight, &c)) return 0;
    }
    memcpy(pose, c.r, 3 * sizeof(double));
    return 1;
}

/* -- derivatives ---------------------------------------------------------------------------- */

/* An equilibrium with its derivatives. */
typedef struct {
    int known;
    double *state;             /* of the equilibrium (rod_state_size) */
    double *a, *da;            /* sections */
    double r[3], R[9];         /* of the tip; R row by row */
    double *turn;              /* of the tip, per wrench and pressure (6 + n, 3) */
    double *twist;             /* the tip's, in base axes, per wrench and pressure (6 + n, 6) */
    double per_turn[9];        /* r by a turn of the tip, row by row */
    double inverse[9];         /* of the base's turn by it, row by row */
    double dn[FIRST * 3];      /* force per first direction */
    double *trace;
    double *notes; /* of all steps, if the caller sets it to memory (notes_size) */
} Linear;

/* Number of directions of the notes of linearise: the first, then pressures from the tip on. */
static int64_t noted_directions(const Rod *rod) { return FIRST + rod->n; }

/* Index of a pressure's direction. */
static int64_t direction_of(const Rod *rod, int64_t pressure) {
    int64_t direction = FIRST;
    const RodPiece *piece = rod->piece;
    for (; pressure < piece->channel || pressure >= piece->channel + piece->channels; piece++)
        direction += piece->channels;
    return direction + pressure - piece->channel;
}

static int64_t notes_size(const Rod *rod, int64_t noted) {
    return BLOCKS * block_size(noted) * (rod->steps + rod->pieces);
}

static int64_t linear_size(const Rod *rod) {
    return rod_state_size(rod) + rod->parts + rod->slopes + 9 * (6 + rod->n) +
           SLOT * (STAGES * rod->steps + rod->pieces);
}

static Linear linear_in(const Rod *rod, double *memory) {
    Linear l = {.known = 0};
    l.state = memory, memory += rod_state_size(rod);
    l.a = memory, memory += rod->parts;
    l.da = memory, memory += rod->slopes;
    l.turn = memory, memory += 3 * (6 + rod->n);
    l.twist = memory, memory += 6 * (6 + rod->n);
    l.trace = memory;
    return l;
}

/* Compute derivatives of the rod at an equilibrium by the implicit function theorem. */
static int linearise(const Work *work, const Rod *rod, const double *state, Linear *l) {
    size_t size = (size_t)rod_state_size(rod) * sizeof(double);
    if (l->known && !memcmp(l->state, state, size)) return 1;
    l->known = 0;
    memcpy(l->state, state, size);
    Condition at = condition_of(rod, l->state);
    int64_t most = noted_directions(rod);
    double Y[8 * most], X[4 * most], R[9];
    memset(X, 0, sizeof X), memset(Y, 0, sizeof Y), memset(l->dn, 0, sizeof l->dn);
    Carried c = {.directions = FIRST, .Y = Y, .X = X};
    if (!sections_at(work, rod, &at, l->a, l->da)) return 0;
    if (!start_at_tip(work, rod, &at, l->state + rod->n, l->dn, R, &c)) return 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) l->R[3 * i + j] = R[3 * j + i];
    for (int i = 0; i < 3; i++) l->dn[3 * (TURNS + i) + i] = 1, Y[8 * (TURNS + 3 + i) + 4 + i] = 1;
    c.forced = WITH_FORCE, c.trace = l->trace;
    c.notes = l->notes, c.noted = noted_directions(rod);
    for (int64_t k = 0; k < rod->pieces; k++) {
        const RodPiece *piece = rod->piece + k;
        if (piece->kind < 0) {
            if (!rigid_stretch(work, piece, 12, &c)) return 0;
            continue;
        }
        double weight[3];
        weight_of(piece, &at, weight);
        c.directions += piece->channels;
        for (int64_t i = 0; i < piece->steps; i++)
            if (!long_step(work, piece, l->a + piece->parts, l->da + piece->slopes, weight,
                           piece->channels, &c))
                return 0;
    }
    double base[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            base[3 * i + j] = Y[8 * j + 1 + i], l->per_turn[3 * i + j] = X[4 * j + i];
    if (!invert_3x3(base, l->inverse)) return 0;
    for (int64_t k = 0; k < 6 + rod->n; k++) {
        int64_t from = k < 6 ? TURNS + k : direction_of(rod, k - 6);
        double *turn = l->turn + 3 * k, *twist = l->twist + 6 * k;
        for (int i = 0; i < 3; i++) {
            turn[i] = 0;
            for (int j = 0; j < 3; j++) turn[i] -= l->inverse[3 * i + j] * Y[8 * from + 1 + j];
        }
        for (int i = 0; i < 3; i++) {
            twist[i] = X[4 * from + i], twist[3 + i] = 0;
            for (int j = 0; j < 3; j++) {
                twist[i] += l->per_turn[3 * i + j] * turn[j];
                twist[3 + i] += l->R[3 * i + j] * turn[j];
            }
        }
    }
    memcpy(l->r, c.r, sizeof l->r);
    for (int i = 0; i < 3; i++)
        if (!isfinite(l->r[i])) return 0;
    return l->known = 1;
}

/* The tip's twist in its own axes by a pressure. */
static void body_twist(const Linear *l, int64_t pressure, double *twist) {
    const double *base = l->twist + 6 * (6 + pressure), *turn = l->turn + 3 * (6 + pressure);
    for (int i = 0; i < 3; i++) {
        twist[i] = 0;
        for (int j = 0; j < 3; j++) twist[i] += l->R[3 * j + i] * base[j];
        twist[3 + i] = turn[i];
    }
}

#ifdef RIGID_ADJOINT_N_IN
/* Add d(y' C z)/dp to a gradient (n), with C (6, 6) the compliance in base axes.
 *
 * S = y' (r_dot, R delta_dot) + mu' Phi_dot along (delta_dot, z) is stationary in delta_dot and in
 * mu, so this is the derivative of S with both fixed.  Changes along that direction are combined
 * from those that linearise noted, and one backward sweep gives the derivatives.
 */
static int add_curvature(const Work *work, const Rod *rod, const Linear *l, const double *y,
                         const double *z, double *gradient) {
    double share[FIRST], mu[3], pull[3], force_dot[3] = {0, 0, 0};
    for (int i = 0; i < 3; i++) {
        share[i] = 0, pull[i] = 0;
        for (int k = 0; k < 6; k++) share[i] += l->turn[3 * k + i] * z[k];
        for (int j = 0; j < 3; j++)
            pull[i] += l->per_turn[3 * j + i] * y[j] + l->R[3 * j + i] * y[3 + j];
    }
    memcpy(share + TURNS, z, 6 * sizeof(double));
    for (int k = 0; k < WITH_FORCE; k++)
        for (int i = 0; i < 3; i++) force_dot[i] += share[k] * l->dn[3 * k + i];
    for (int i = 0; i < 3; i++) {
        mu[i] = 0;
        for (int j = 0; j < 3; j++) mu[i] -= l->inverse[3 * j + i] * pull[j];
    }
    Condition at = condition_of(rod, l->state);
    double by_p[rod->n], lam[8] = {0}, dlam[8] = {0, mu[0], mu[1], mu[2]};
    double lam_n[3] = {0, 0, 0}, dlam_n[3] = {0, 0, 0};
    memset(by_p, 0, sizeof by_p);
    const double *trace = l->trace;
    for (int64_t k = 0; k < rod->pieces; k++)
        trace += SLOT * (rod->piece[k].kind < 0 ? 1 : STAGES * rod->piece[k].steps);
    for (int64_t k = rod->pieces; k-- > 0;) {
        const RodPiece *piece = rod->piece + k;
        int soft = piece->kind >= 0;
        double weight[3], h = piece->length;
        weight_of(piece, &at, weight);
        double own[piece->channels + 1];
        for (int64_t step = soft ? piece->steps : 1; step-- > 0;) {
            double by_y[STAGES][8], by_dy[STAGES][8];
            for (int i = soft ? STAGES : 1; i-- > 0;) {
                trace -= SLOT;
                double dy[8] = {0}, bar[8], dbar[12] = {0}, by_n[3], by_dn[3];
                for (int d = 0; d < FIRST; d++)
                    for (int j = 0; j < 8; j++) dy[j] += share[d] * trace[12 + 8 * d + j];
                double part = soft ? h * WEIGHT[i] : 1;
                for (int j = 0; j < 8; j++) bar[j] = part * lam[j], dbar[j] = part * dlam[j];
                for (int j = 0; j < 3; j++) dbar[8 + j] = part * y[j];
                for (int later = i + 1; soft && later < STAGES; later++)
                    for (int c = 0; c < TABLE[later].count; c++) {
                        if (TABLE[later].from[c] != i) continue;
                        double by = h * TABLE[later].a[c];
                        for (int j = 0; j < 8; j++)
                            bar[j] += by * by_y[later][j], dbar[j] += by * by_dy[later][j];
                    }
                work->arg[0] = trace, work->arg[1] = trace + 8;
                if (soft) {
                    work->arg[2] = weight, work->arg[3] = l->a + piece->parts;
                    work->arg[4] = l->da + piece->slopes, work->arg[5] = dy;
                    work->arg[6] = force_dot;
                    work->arg[7] = bar, work->arg[8] = dbar;
                    work->res[0] = by_y[i], work->res[1] = by_n, work->res[2] = own;
                    work->res[3] = by_dy[i], work->res[4] = by_dn;
                    if (section_adjoint(work, piece->kind)) return 0;
                    for (int64_t j = 0; j < piece->channels; j++)
                        by_p[piece->channel + j] += own[j];
                } else {
                    work->arg[2] = &piece->length, work->arg[3] = dy, work->arg[4] = force_dot;
                    work->arg[5] = bar, work->arg[6] = dbar;
                    work->res[0] = by_y[0], work->res[1] = by_n;
                    work->res[2] = by_dy[0], work->res[3] = by_dn;
                    if (rigid_adjoint(work->arg, work->res, work->iw, work->w, 0)) return 0;
                }
                for (int j = 0; j < 3; j++) lam_n[j] += by_n[j], dlam_n[j] += by_dn[j];
            }
            for (int i = 0; i < (soft ? STAGES : 1); i++)
                for (int j = 0; j < 8; j++) lam[j] += by_y[i][j], dlam[j] += by_dy[i][j];
        }
    }
    double by_turn[3];
    work->arg[0] = l->state + rod->n, work->arg[1] = at.load, work->arg[2] = share;
    work->arg[3] = z;
    work->arg[4] = lam, work->arg[5] = lam_n, work->arg[6] = dlam, work->arg[7] = dlam_n;
    work->arg[8] = y;
    work->res[0] = by_turn;
    if (tip_adjoint(work->arg, work->res, work->iw, work->w, 0)) return 0;
    for (int64_t i = 0; i < rod->n; i++) {
        const double *turn = l->turn + 3 * (6 + i);
        gradient[i] += by_p[i] + by_turn[0] * turn[0] + by_turn[1] * turn[1] +
                       by_turn[2] * turn[2];
    }
    return 1;
}
#endif

/* -- called by `LoadedArm` ------------------------------------------------------------------ */

/* Find the state of the unpressurised arm under its weight; return 0 if it falls over. */
int stiffopt_hang(const Rod *rod, double *state) {
    NEW_WORK(work);
    return hang(&work, rod, state);
}

/* Find equilibria from rest at pressures begin to end - 1 (n each, in Pa), and whether each exists:
 * states, and poses (12): position, rotation by columns. */
int stiffopt_settle(const Rod *rod, const double *pressures, double *states, double *poses,
                    int64_t *found, int64_t begin, int64_t end) {
    NEW_WORK(work);
    int64_t size = rod_state_size(rod);
    for (int64_t i = begin; i < end; i++) {
        double *state = states + i * size;
        found[i] = settle(&work, rod, pressures + i * rod->n, state) &&
                   tip_pose(&work, rod, state, poses + 12 * i, NULL);
    }
    return 0;
}

#endif
