/* The tip of an arm under gravity or loads at successive pressures. */
#include <stdint.h>

#include "functions.h"
#include "rod.h"

enum { FOUND, BEYOND_LAW, NO_EQUILIBRIUM };

/* Number of doubles that stiffopt_tip needs as memory. */
int64_t stiffopt_tip_memory(const Rod *rod) { return linear_size(rod); }

/* Compute a block (3, 3) in the tip's axes: R' B R.  B is a block of a matrix (6, 6) stored by
 * columns, `to` one of a matrix (6, 6) stored by rows. */
static void block_in_tip(const double *R, const double *B, double *to) {
    double turned[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double sum = 0;
            for (int k = 0; k < 3; k++) sum += B[6 * k + i] * R[3 * k + j];
            turned[3 * i + j] = sum;
        }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double sum = 0;
            for (int k = 0; k < 3; k++) sum += R[3 * k + i] * turned[3 * k + j];
            to[6 * i + j] = sum;
        }
}

/* Write pose (4, 4), Jacobian (6, n) and compliance (6, 6) in the tip's axes, row by row. */
static void write_tip(const Rod *rod, const Linear *l, double *pose) {
    int64_t n = rod->n;
    double *jacobian = pose + 16, *compliance = jacobian + 6 * n;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) pose[4 * i + j] = l->R[3 * i + j];
        pose[4 * i + 3] = l->r[i], pose[12 + i] = 0;
    }
    pose[15] = 1;
    for (int64_t k = 0; k < n; k++) {
        double twist[6];
        body_twist(l, k, twist);
        for (int i = 0; i < 6; i++) jacobian[n * i + k] = twist[i];
    }
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++)
            block_in_tip(l->R, l->twist + 18 * j + 3 * i, compliance + 18 * i + 3 * j);
    for (int i = 3; i < 12; i++)
        if (rod->load[i] != 0) return;
    /* with dead forces only, it is symmetric up to the integrator's error of about 1e-6 */
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < i; j++)
            compliance[6 * i + j] = compliance[6 * j + i] =
                (compliance[6 * i + j] + compliance[6 * j + i]) / 2;
}

/* Compute the tip at pressures (n): pose, Jacobian and compliance.  The equilibrium is followed
 * from `state`; if that begins with NaN or fails, from rest.  `state` is updated; without an
 * equilibrium it begins with NaN. */
int stiffopt_tip(const Rod *rod, const double *pressures, double *state, double *memory,
                 double *found) {
    NEW_WORK(work);
    double least;
    work.arg[0] = pressures, work.arg[1] = rod->numbers, work.res[0] = &least;
    if (margin(work.arg, work.res, work.iw, work.w, 0) || !(least > 0)) return BEYOND_LAW;
    Linear l = linear_in(rod, memory);
    if ((!isnan(state[0]) && settle_nearby(&work, rod, pressures, 1, state)) ||
        settle(&work, rod, pressures, state))
        if (linearise(&work, rod, state, &l)) {
            write_tip(rod, &l, found);
            return FOUND;
        }
    state[0] = NAN;
    return NO_EQUILIBRIUM;
}
