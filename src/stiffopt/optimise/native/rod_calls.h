/* Equilibria of an arm under gravity or loads, as `LoadedArm` calls for them. */
#ifndef STIFFOPT_ROD_CALLS_H
#define STIFFOPT_ROD_CALLS_H

#include "rod.h"

/* State of the unpressurised arm under its weight; 0 where it falls over. */
int stiffopt_hang(const Rod *rod, double *state) {
    const double *arg[WORK_ARG];
    double *res[WORK_RES], w[WORK_W + 1];
    casadi_int iw[WORK_IW + 1];
    Work work = {arg, res, iw, w};
    return hang(&work, rod, state);
}

/* Equilibria from rest at pressures begin to end - 1 (n each, in Pa), and whether there are any:
 * states, and poses (12): position, rotation by columns. */
int stiffopt_settle(const Rod *rod, const double *pressures, double *states, double *poses,
                    int64_t *found, int64_t begin, int64_t end) {
    const double *arg[WORK_ARG];
    double *res[WORK_RES], w[WORK_W + 1];
    casadi_int iw[WORK_IW + 1];
    Work work = {arg, res, iw, w};
    int64_t size = rod_state_size(rod);
    for (int64_t i = begin; i < end; i++) {
        double *state = states + i * size;
        found[i] = settle(&work, rod, pressures + i * rod->n, state) &&
                   tip_pose(&work, rod, state, poses + 12 * i);
    }
    return 0;
}

#endif
