/* Whether the body of an arm stays clear of a scene while its pressures go straight from one row to
 * the next: adaptive, and for all that is between the poses that are looked at.
 *
 * Between two poses with distances d0 and d1, of which no point of the body is further apart than c
 * and leaves its chord by more than e on its way, the distance is at least (d0 + d1 - c) / 2 - e.
 * With `way` the most that the body moves (see speeds below) another bound is (d0 + d1 - way) / 2;
 * and e <= way^2 / (8 bend), as the second derivative along a way is at most its speed^2 / bend.
 * A stretch for which neither is enough is divided, the widest first, so that what is in the way is
 * soon seen.  Distances of grids change by STEEPEST as much as the body moves.  A ring's is lost at
 * once where the tip leaves the disc: until then the tip's distance from it counts too.
 */
#ifndef STIFFOPT_MOTION_H
#define STIFFOPT_MOTION_H

enum { MOTION_CLEAR, MOTION_BLOCKED, MOTION_NO_SHAPE };

#define MOST_POSES 8192   /* of a stretch; what needs more is taken to be blocked */
#define SAG 1e-5          /* m, by which the distance may be less between poses */
#define BETWEEN 1.1       /* the most that stations move over what coarse ones do */

typedef struct {
    double share, spare; /* of the way; distance beyond what is asked */
} Pose;

typedef struct {
    int32_t from, to;
} Stretch;

typedef struct {
    Scenery *scenery;
    const double *from, *to; /* pressures (n) */
    int64_t n, stations;
    double asked, way, bend, steep;
    int64_t count, ends;
    Pose *poses;        /* (MOST_POSES) */
    double *places;     /* (MOST_POSES, stations, 4): positions and radii */
    Stretch *stretches; /* (2 MOST_POSES) */
} Way;

/* Look at a share of the way: the least distance, exact as far as it matters, and the pose. */
static int look(Way *w, double share, double *least) {
    Scenery *a = w->scenery;
    double pressures[w->n], *place = w->places + 4 * w->stations * w->count;
    Nearest nearest;
    for (int64_t k = 0; k < w->n; k++)
        pressures[k] = w->from[k] + share * (w->to[k] - w->from[k]);
    if (survey_body(a, pressures, 0) != FOUND) return MOTION_NO_SHAPE;
    if (!not_above(a->objects, a->n_objects, a->ranges, a->n_ranges, least)) return MOTION_NO_SHAPE;
    *least = fmin(*least, w->asked + w->steep * w->way); /* more clears the whole way */
    for (int64_t j = 0; j < a->n_objects && *least >= w->asked; j++) {
        if (!object_nearest(&a->line, a->objects + j, a->ranges, a->n_ranges, *least, &nearest))
            return MOTION_NO_SHAPE;
        *least = fmin(*least, nearest.distance);
    }
    for (int64_t i = 0; i < w->stations; i++, place += 4) {
        memcpy(place, a->points[i].position, 3 * sizeof(double));
        place[3] = a->points[i].radius;
    }
    double spare = *least - w->asked;
    const BodyPoint *tip = a->points + w->stations - 1;
    for (int64_t j = 0; j < a->n_objects && spare >= 0; j++) {
        Passage passage;
        if (!a->objects[j].passage) continue;
        if (!passage_of(a->objects + j, tip->position, &passage)) return MOTION_NO_SHAPE;
        spare = fmin(spare, passage.from_disc);
    }
    w->poses[w->count++] = (Pose){share, spare};
    return spare >= 0 ? MOTION_CLEAR : MOTION_BLOCKED;
}

/* The most that the body is apart in two poses. */
static double apart(const Way *w, int32_t first, int32_t second) {
    const double *a = w->places + 4 * w->stations * first;
    const double *b = w->places + 4 * w->stations * second;
    double most = 0;
    for (int64_t i = 0; i < w->stations; i++, a += 4, b += 4)
        most = fmax(most, scene_far(a, b) + fabs(a[3] - b[3]));
    return BETWEEN * most;
}

/* Note a stretch, unless it is clear as it is. */
static void consider(Way *w, int32_t from, int32_t to) {
    const Pose *a = w->poses + from, *b = w->poses + to;
    double way = w->way * (b->share - a->share), both = a->spare + b->spare;
    if (both - w->steep * way >= -2 * SAG) return;
    double chord = apart(w, from, to) + way * way / (4 * w->bend);
    if (both - w->steep * chord >= -2 * SAG) return;
    w->stretches[w->ends++] = (Stretch){from, to};
}

/* Whether all is clear on the way; the last pose is the one that is not. */
static int go(Way *w, double *least) {
    w->count = w->ends = 0;
    for (int k = 0; k < 2; k++) {
        double seen;
        int outcome = look(w, k, &seen);
        if (outcome == MOTION_NO_SHAPE) return outcome;
        *least = fmin(*least, seen);
        if (outcome) return outcome;
    }
    consider(w, 0, 1);
    for (int64_t k = 0; k < w->ends; k++) {
        if (w->count == MOST_POSES) return MOTION_BLOCKED;
        Stretch now = w->stretches[k];
        const Pose *a = w->poses + now.from, *b = w->poses + now.to;
        double wide = b->share - a->share, seen;
        double aside = (a->spare - b->spare) / (2 * w->steep * apart(w, now.from, now.to));
        int32_t middle = (int32_t)w->count;
        int outcome = look(w, a->share + wide * (0.5 + fmin(fmax(aside, -0.3), 0.3)), &seen);
        if (outcome == MOTION_NO_SHAPE) return outcome;
        *least = fmin(*least, seen);
        if (outcome) return outcome;
        consider(w, now.from, middle), consider(w, middle, now.to);
    }
    return MOTION_CLEAR;
}

/* What is judged, and memory for it; mirrored by `_Motions` in motion_clearance.py. */
typedef struct {
    const BodyModel *model;
    const SceneObject *objects;
    int64_t n_objects;
    const double *ends; /* (ranges, 2) of the ranges */
    const int64_t *counts;
    int64_t n_ranges;
    const double *speeds; /* (pieces), the most that the body moves per change of a piece's pressures */
    double bend;
    double *memory; /* (stiffopt_motion_memory) */
} Motions;

static int64_t stations_of(const Motions *m) {
    int64_t total = 0;
    for (int64_t r = 0; r < m->n_ranges; r++) total += m->counts[r];
    return total;
}

/* How many numbers the memory holds. */
int64_t stiffopt_motion_memory(const Motions *m) {
    return scenery_size(m->model, m->counts, m->n_ranges) +
           MOST_POSES * (int64_t)((sizeof(Pose) + 2 * sizeof(Stretch)) / sizeof(double)) +
           MOST_POSES * 4 * stations_of(m);
}

/* Whether all is clear along rows of pressures (rows, n), from one to the next.  found has (2 + n)
 * numbers: the least distance that was seen (of what matters), how many poses were looked at, and,
 * where the way is not clear, the pressures there.  Returns how it ended. */
int stiffopt_motions(const Motions *m, const double *pressures, int64_t rows, double asked,
                     double *found) {
    NEW_WORK(work);
    const BodyModel *model = m->model;
    Range ranges[m->n_ranges];
    Scenery a = {.work = &work, .objects = m->objects, .n_objects = m->n_objects, .ends = m->ends,
                 .ranges = ranges, .n_ranges = m->n_ranges};
    Way w = {.scenery = &a, .n = model->n, .stations = stations_of(m), .asked = asked,
             .bend = m->bend, .steep = 1};
    double *memory = furnish(&a, model, m->counts, m->memory);
    w.poses = (Pose *)memory, memory += MOST_POSES * (int64_t)(sizeof(Pose) / sizeof(double));
    w.places = memory, memory += MOST_POSES * 4 * w.stations;
    w.stretches = (Stretch *)memory;
    for (int64_t j = 0; j < m->n_objects; j++)
        if (m->objects[j].cell) w.steep = STEEPEST;
    int outcome = MOTION_CLEAR;
    found[0] = INFINITY, found[1] = 0;
    for (int64_t i = 0; i + 1 < rows && outcome == MOTION_CLEAR; i++) {
        double squares[model->pieces];
        w.from = pressures + i * w.n, w.to = w.from + w.n, w.way = 0;
        for (int64_t k = 0; k < model->pieces; k++) squares[k] = 0;
        for (int64_t k = 0; k < w.n; k++)
            squares[model->piece_of[k]] += (w.to[k] - w.from[k]) * (w.to[k] - w.from[k]);
        for (int64_t k = 0; k < model->pieces; k++) w.way += m->speeds[k] * sqrt(squares[k]);
        outcome = go(&w, found);
        found[1] += (double)w.count;
        if (outcome == MOTION_BLOCKED)
            for (int64_t k = 0; k < w.n; k++)
                found[2 + k] = w.from[k] + w.poses[w.count - 1].share * (w.to[k] - w.from[k]);
    }
    return outcome;
}

#endif
