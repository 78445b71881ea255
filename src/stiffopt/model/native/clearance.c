/* The clearance of an arm in a scene, for rows of pressures; includes the functions of body.c. */
#if defined(__GNUC__) && !defined(STIFFOPT_LOADED)
#pragma GCC optimize("O2") /* small functions, called often; the results are the same */
#endif
#include "body.c"
#include "scene.h"

/* Compute the change (n) of a distance with the pressures. */
static int put_gradient(const Work *work, const Body *body, const Nearest *nearest, double *to) {
    int64_t n = body->model->n;
    double twists[6 * n], slopes[n];
    Station found;
    if (!moving_station(work, body, nearest->s, &found, twists, slopes)) return 0;
    for (int64_t k = 0; k < n; k++)
        to[k] = scene_dot(nearest->normal, twists + 6 * k) - nearest->radius_share * slopes[k];
    return 1;
}

/* Find the point of a body nearest to each object. */
static int nearest_of_each(const CentreLine *line, const SceneObject *objects, int64_t count,
                           const Range *ranges, int64_t n_ranges, Nearest *found) {
    for (int64_t i = 0; i < count; i++)
        if (!object_nearest(line, objects + i, ranges, n_ranges, INFINITY, found + i)) return 0;
    return 1;
}

/* Compute an upper bound of the least distance, from the ends of the ranges. */
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

/* Find the least distance of all objects. */
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

/* Body, ranges and memory for the clearances of an arm's poses. */
typedef struct {
    const Work *work;
    Body body;
    BodyLine arm;
    CentreLine line;
    const SceneObject *objects;
    int64_t n_objects;
    const double *ends; /* (ranges, 2) */
    Range *ranges;
    int64_t n_ranges;
    double *state; /* the equilibrium */
    BodyPoint *points;
} Scenery;

static int64_t scenery_size(const BodyModel *model, const int64_t *counts, int64_t n_ranges) {
    int64_t total = 0;
    for (int64_t r = 0; r < n_ranges; r++) total += counts[r];
    return state_size(model) + body_size(model) +
           total * (int64_t)(sizeof(BodyPoint) / sizeof(double)) + 1;
}

/* Assign memory to the parts; return the address after it. */
static double *furnish(Scenery *a, const BodyModel *model, const int64_t *counts, double *memory) {
    double *body = memory + state_size(model);
    a->state = memory;
    a->body = body_in(model, body);
    a->arm = (BodyLine){a->work, &a->body};
    a->line = (CentreLine){body_line_station, &a->arm};
    a->points = (BodyPoint *)(body + body_size(model));
    BodyPoint *next = a->points;
    for (int64_t r = 0; r < a->n_ranges; next += counts[r++])
        a->ranges[r] = (Range){counts[r], next};
    return memory + scenery_size(model, counts, a->n_ranges);
}

/* Prepare the body at some pressures, with coarse stations on its ranges. */
static int survey_body(Scenery *a, const double *pressures, int moving) {
    int outcome = settle_body(a->work, &a->body, pressures, a->state, moving);
    for (int64_t r = 0; outcome == FOUND && r < a->n_ranges; r++)
        if (!survey(&a->line, a->ends[2 * r], a->ends[2 * r + 1], a->ranges + r))
            outcome = NO_EQUILIBRIUM;
    return outcome;
}

/* Compute for pressures begin to end - 1 of rows (n) the least distance, the only valid field of
 * found (N); or, if gradients is not NULL, the nearest point of each object, found (N, objects),
 * and the changes of distances (N, objects, n).  Set an outcome for each row.  Ranges have ends
 * (ranges, 2) and numbers of coarse stations (ranges).  Return nonzero if out of memory. */
int stiffopt_clearances(const BodyModel *model, const SceneObject *objects, int64_t n_objects,
                        const double *ends, const int64_t *counts, int64_t n_ranges,
                        const double *pressures, Nearest *found, double *gradients,
                        int64_t *outcome, int64_t begin, int64_t end) {
    NEW_WORK(work);
    Range ranges[n_ranges];
    Scenery a = {.work = &work, .objects = objects, .n_objects = n_objects, .ends = ends,
                 .ranges = ranges, .n_ranges = n_ranges};
    double *memory =
        malloc((size_t)scenery_size(model, counts, n_ranges) * sizeof(double));
    if (!memory) return 1;
    furnish(&a, model, counts, memory);
    int64_t n = model->n, width = gradients ? n_objects : 1;
    for (int64_t i = begin; i < end; i++) {
        Nearest *to = found + i * width;
        outcome[i] = survey_body(&a, pressures + i * n, gradients != NULL);
        if (outcome[i] != FOUND) continue;
        int good = (gradients ? nearest_of_each : least_of_all)(&a.line, objects, n_objects, ranges,
                                                                n_ranges, to);
        for (int64_t j = 0; good && gradients && j < n_objects; j++)
            good = put_gradient(&work, &a.body, to + j, gradients + (i * n_objects + j) * n);
        if (!good) outcome[i] = NO_EQUILIBRIUM;
    }
    free(memory);
    return 0;
}

#include "motion.h"
