/* Nearest points on a body that is given by a callback, for callers outside C. */
#include <stdlib.h>

#include "scene.h"

/* Size of a SceneObject, for the caller to check that it has the same fields. */
int64_t stiffopt_scene_object_size(void) { return sizeof(SceneObject); }

/* Find the point nearest to each object on a body with ranges (count, 2) of stations (count). */
int stiffopt_nearest(const SceneObject *objects, int64_t n_objects, StationOf station,
                     const void *body, const double *ends, const int64_t *stations, int64_t count,
                     double cutoff, Nearest *nearest) {
    CentreLine line = {station, body};
    int64_t total = 0;
    for (int64_t r = 0; r < count; r++) total += stations[r];
    BodyPoint *points = malloc((size_t)total * sizeof(BodyPoint));
    Range ranges[count];
    int failed = !points;
    for (int64_t r = 0, used = 0; !failed && r < count; used += stations[r++]) {
        ranges[r] = (Range){stations[r], points + used};
        failed = !survey(&line, ends[2 * r], ends[2 * r + 1], ranges + r);
    }
    for (int64_t i = 0; !failed && i < n_objects; i++)
        failed = !object_nearest(&line, objects + i, ranges, count, cutoff, nearest + i);
    free(points);
    return failed;
}
