/* Stations along an arm, for rows of pressures. */
#include <stdlib.h>

#include "functions.h"
#include "body.h"

enum { FOUND, BEYOND_LAW, NO_EQUILIBRIUM };
enum { POSES, JACOBIANS, CARRIED, LINE };

/* Size of a BodyModel, for the caller to check that it has the same fields. */
int64_t stiffopt_body_model_size(void) { return sizeof(BodyModel); }

/* Write the pose (4, 4), row by row. */
static void put_pose(const Station *station, double *to) {
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) to[4 * i + j] = station->axes[3 * j + i];
        to[4 * i + 3] = station->position[i], to[12 + i] = 0;
    }
    to[15] = 1;
}

/* Write the Jacobian (6, n) in the station's axes, row by row. */
static void put_jacobian(const Station *station, int64_t n, const double *twists, double *to) {
    for (int64_t k = 0; k < 2 * n; k++, twists += 3) {
        double *column = to + k / 2 + (k % 2) * 3 * n;
        const double *axis = station->axes;
        for (int i = 0; i < 3; i++, axis += 3)
            column[n * i] = axis[0] * twists[0] + axis[1] * twists[1] + axis[2] * twists[2];
    }
}

#ifdef STIFFOPT_LOADED
/* Find the equilibrium from rest, and prepare the body there. */
static int settle_body(const Work *work, Body *b, const double *pressures, double *state,
                       int moving) {
    double least;
    work->arg[0] = pressures, work->arg[1] = b->model->numbers, work->res[0] = &least;
    if (margin(work->arg, work->res, work->iw, work->w, 0) || !(least > 0)) return BEYOND_LAW;
    if (!settle(work, b->rod, pressures, state) || !prepare_body(work, b, pressures, state, moving))
        return NO_EQUILIBRIUM;
    return FOUND;
}

static int64_t state_size(const BodyModel *m) { return rod_state_size(m->rod); }
#else
static int settle_body(const Work *work, Body *b, const double *pressures, double *state,
                       int moving) {
    return prepare_body(work, b, pressures, state, moving) ? FOUND : BEYOND_LAW;
}

static int64_t state_size(const BodyModel *m) { return 0; }
#endif

/* Compute a quantity of stations at arc lengths (count) for pressures begin to end - 1 of rows (n):
 * poses (count, 16), Jacobians (count, 6 n), positions, tangents and radii (count, 7) or, under
 * loads, outputs of carried_to (count, 81) and changes of force (9, 3); and an outcome for each
 * row. Return nonzero if out of memory. */
int stiffopt_stations(const BodyModel *model, int64_t what, const double *pressures,
                      const double *at, int64_t count, double *found, int64_t *outcome,
                      int64_t begin, int64_t end) {
    NEW_WORK(work);
    int64_t n = model->n, states = state_size(model);
    int64_t width = what == POSES ? 16 : what == LINE ? 7 : what == JACOBIANS ? 6 * n : 81;
    int64_t row = count * width + (what == CARRIED ? 27 : 0);
    double *memory = malloc((size_t)(body_size(model) + states + 1) * sizeof(double));
    double *state = memory, twists[6 * n], slopes[n];
    if (!memory) return 1;
    Body body = body_in(model, memory + states);
    BodyLine line = {&work, &body};
    for (int64_t i = begin; i < end; i++) {
        double *to = found + i * row;
        Station station;
        int moving = what == JACOBIANS || what == CARRIED;
        outcome[i] = settle_body(&work, &body, pressures + i * n, state, moving);
        for (int64_t k = 0; k < count && outcome[i] == FOUND; k++, to += width) {
            if (what == POSES) {
                station_at(&work, &body, at[k], &station);
                put_pose(&station, to);
            } else if (what == LINE) {
                body_line_station(&line, at[k], to, to + 3, to + 6);
            } else if (what == JACOBIANS) {
                moving_station(&work, &body, at[k], &station, twists, slopes);
                put_jacobian(&station, n, twists, to);
            }
#ifdef STIFFOPT_LOADED
            else
                carried_to(&work, &body, at[k], &station, to);
#endif
        }
#ifdef STIFFOPT_LOADED
        if (what == CARRIED) memcpy(to, body.linear->dn, 27 * sizeof(double));
#endif
    }
    free(memory);
    return 0;
}
