/* The clearance of an arm to a scene, for rows of pressures, with all that body.c has. */
#include "body.c"
#include "scene.h"

/* The change (n) of a distance with the pressures. */
static int put_gradient(const Work *work, const Body *body, const Nearest *nearest, double *to) {
    int64_t n = body->model->n;
    double twists[6 * n], slopes[n];
    Station found;
    if (!moving_station(work, body, nearest->s, &found, twists, slopes)) return 0;
    for (int64_t k = 0; k < n; k++)
        to[k] = scene_dot(nearest->normal, twists + 6 * k) - nearest->radius_share * slopes[k];
    return 1;
}

/* The objects' nearest points on a body. */
static int nearest_of_each(const CentreLine *line, const SceneObject *objects, int64_t count,
                           const Range *ranges, int64_t n_ranges, Nearest *found) {
    for (int64_t i = 0; i < count; i++)
        if (!object_nearest(line, objects + i, ranges, n_ranges, INFINITY, found + i)) return 0;
    return 1;
}

/* A distance that the least is not above, from the ends of the ranges. */
static int not_above(const SceneObject *objects, int64_t count, const Range *ranges,
                     int64_t n_ranges, double *least) {
    double distance, normal[3];
    int64_t piece;
    *least = INFINITY;
    for (int64_t i = 0; i < count; i++) {
        double most[objects[i].pieces];
        PieceBounds bounds = no_bounds(objects + i, most);
        for (int64_t r = 0; r < n_ranges && !objects[i].passage; r++) {
            const BodyPoint *end = ranges[r].points + ranges[r].count - 1;
            if (!object_distance(objects + i, &bounds, end->position, &distance, normal, &piece)) return 0;
            *least = fmin(*least, distance - end->radius);
        }
    }
    return 1;
}

/* The least distance of all objects. */
static int least_of_all(const CentreLine *line, const SceneObject *objects, int64_t count,
                        const Range *ranges, int64_t n_ranges, Nearest *found) {
    Nearest nearest;
    if (!not_above(objects, count, ranges, n_ranges, &found->distance)) return 0;
    for (int64_t i = 0; i < count; i++) {
        double cutoff = found->distance;
        if (!object_nearest(line, objects + i, ranges, n_ranges, cutoff, &nearest)) return 0;
        if (nearest.distance < cutoff) *found = nearest;
    }
    return 1;
}

/* For pressures begin to end - 1 of rows (n): the least distance, which alone of found (N) is then
 * valid; or, where gradients is not NULL, the nearest point of each object, found (N, objects), and
 * the changes of distances (N, objects, n).  And how it went for each row.  Ranges have ends
 * (ranges, 2) and numbers of coarse stations (ranges).  Not 0 if memory is short. */
int stiffopt_clearances(const BodyModel *model, const SceneObject *objects, int64_t n_objects,
                        const double *ends, const int64_t *counts, int64_t n_ranges,
                        const double *pressures, Nearest *found, double *gradients,
                        int64_t *outcome, int64_t begin, int64_t end) {
    NEW_WORK(work);
    int64_t n = model->n, states = state_size(model), total = 0, used = 0;
    for (int64_t r = 0; r < n_ranges; r++) total += counts[r];
    double *memory = malloc((size_t)(body_size(model) + states + 1) * sizeof(double));
    BodyPoint *points = malloc((size_t)total * sizeof(BodyPoint));
    Range ranges[n_ranges];
    for (int64_t r = 0; r < n_ranges; used += counts[r++])
        ranges[r] = (Range){counts[r], points + used};
    if (!memory || !points) return free(memory), free(points), 1;
    Body body = body_in(model, memory + states);
    BodyLine arm = {&work, &body};
    CentreLine line = {body_line_station, &arm};
    int64_t width = gradients ? n_objects : 1;
    for (int64_t i = begin; i < end; i++) {
        Nearest *to = found + i * width;
        outcome[i] = settle_body(&work, &body, pressures + i * n, memory, gradients != NULL);
        int good = outcome[i] == FOUND;
        for (int64_t r = 0; good && r < n_ranges; r++)
            good = survey(&line, ends[2 * r], ends[2 * r + 1], ranges + r);
        good = good && (gradients ? nearest_of_each : least_of_all)(&line, objects, n_objects, ranges,
                                                                    n_ranges, to);
        for (int64_t j = 0; good && gradients && j < n_objects; j++)
            good = put_gradient(&work, &body, to + j, gradients + (i * n_objects + j) * n);
        if (!good && outcome[i] == FOUND) outcome[i] = NO_EQUILIBRIUM;
    }
    free(memory), free(points);
    return 0;
}
