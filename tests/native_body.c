/* native/body.h as another library would use it: all that it gives of stations, side by side. */
#include "functions.h"
#ifdef RADII_N_IN
#define STIFFOPT_LOADED
#endif
#include "body.c"

/* A station's position, tangent, radius, twists (n, 6) and changes of the radius (n); not 0 where
 * anything fails. */
int tested_station(const BodyModel *model, const double *pressures, double s, double *found) {
    NEW_WORK(work);
    int failed = 0;
    Station station;
    double *memory = malloc((size_t)body_size(model) * sizeof(double)), *state = NULL;
    Body body = body_in(model, memory);
#ifdef STIFFOPT_LOADED
    state = malloc((size_t)rod_state_size(model->rod) * sizeof(double));
    failed = !settle(&work, model->rod, pressures, state);
#endif
    failed = failed || !prepare_body(&work, &body, pressures, state, 1) ||
             !moving_station(&work, &body, s, &station, found + 7, found + 7 + 6 * model->n);
    memcpy(found, station.position, 3 * sizeof(double));
    memcpy(found + 3, station.tangent, 3 * sizeof(double));
    found[6] = station.radius;
    free(state), free(memory);
    return failed;
}
