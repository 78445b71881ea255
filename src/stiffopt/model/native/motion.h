/* Check that the body of an arm stays clear of a scene while its pressures change linearly from one
 * row to the next, also between the poses that are evaluated.
 *
 * Each range of the body is checked on its own, as parts near the base move little.  Take two poses
 * at which a range has distances d0 and d1.  If none of its points moves further than c between
 * them or leaves its chord by more than e, its distance is at least (d0 + d1 - c) / 2 - e.  With
 * `way` the largest motion of a point (see speeds below), another bound is (d0 + d1 - way) / 2; and
 * e <= way^2 / (8 bend), as second derivatives along the motion are at most its speed^2 / bend. An
 * interval for which neither bound suffices is divided, the widest first, to find obstacles soon.
 * Distances of grids change up to STEEPEST times as much as the body moves.  The distance of a ring
 * is lost at once when the tip leaves its disc, so the tip's distance from the disc counts too.
 */
#ifndef STIFFOPT_MOTION_H
#define STIFFOPT_MOTION_H

enum { MOTION_CLEAR, MOTION_BLOCKED, MOTION_NO_SHAPE };

#define MOST_POSES 8192   /* between two rows; a motion that needs more counts as blocked */
#define SAG 1e-5          /* m, allowed decrease of the distance between poses */
#define BETWEEN 1.1       /* bound on the motion of stations, over that of the coarse ones */

typedef struct {
    int32_t from, to;
} Stretch;

typedef struct {
    Scenery *scenery;
    const double *from, *to; /* pressures (n) */
    int64_t n, stations, ranges;
    double asked, steep;
    const double *bends;     /* (ranges) */
    double *ways;            /* (ranges) */
    int64_t count, ends;
    double *shares;          /* (MOST_POSES) of the way */
    double *spares;          /* (MOST_POSES, ranges), distances beyond the clearance asked for */
    double *places;          /* (MOST_POSES, stations, 4): positions and radii */
    Stretch *stretches;      /* (2 MOST_POSES) */
} Way;

/* Reduce each range's spare distance by that of an object; check that the arm is through a ring. */
static int look_at(Way *w, const SceneObject *object, double *spares, double *least) {
    Scenery *a = w->scenery;
    Nearest nearest;
    SceneObject circle = *object;
    if (object->passage) {
        Passage passage;
        const BodyPoint *tip = a->points + w->stations - 1;
        if (!object_nearest(&a->line, object, a->ranges, w->ranges, INFINITY, &nearest) ||
            !passage_of(object, tip->position, &passage))
            return 0;
        *least = fmin(*least, nearest.distance);
        if (*least < w->asked) return 1;
        spares[w->ranges - 1] = fmin(spares[w->ranges - 1], passage.from_disc);
        circle.passage = NULL;
    }
    for (int64_t r = 0; r < w->ranges; r++) {
        double cutoff = w->asked + spares[r]; /* more clears the whole way */
        if (!object_nearest(&a->line, &circle, a->ranges + r, 1, cutoff, &nearest)) return 0;
        if (nearest.distance >= cutoff) continue;
        spares[r] = nearest.distance - w->asked;
        *least = fmin(*least, nearest.distance);
        if (*least < w->asked) return 1;
    }
    return 1;
}

/* Evaluate the pose at a share of the way and store it; the least distance is exact if needed. */
static int look(Way *w, double share, double *least) {
    Scenery *a = w->scenery;
    double pressures[w->n], *place = w->places + 4 * w->stations * w->count;
    double *spares = w->spares + w->ranges * w->count, here = INFINITY;
    for (int64_t k = 0; k < w->n; k++)
        pressures[k] = w->from[k] + share * (w->to[k] - w->from[k]);
    if (survey_body(a, pressures, 0) != FOUND) return MOTION_NO_SHAPE;
    for (int64_t r = 0; r < w->ranges; r++) {
        spares[r] = w->steep * w->ways[r];
        here = fmin(here, w->asked + spares[r]);
    }
    for (int64_t j = 0; j < a->n_objects && here >= w->asked; j++)
        if (!look_at(w, a->objects + j, spares, &here)) return MOTION_NO_SHAPE;
    for (int64_t i = 0; i < w->stations; i++, place += 4) {
        memcpy(place, a->points[i].position, 3 * sizeof(double));
        place[3] = a->points[i].radius;
    }
    w->shares[w->count++] = share;
    *least = fmin(*least, here);
    return here >= w->asked ? MOTION_CLEAR : MOTION_BLOCKED;
}

/* Largest motion of a range with these stations between two poses. */
static double apart(const double *a, const double *b, int64_t count) {
    double most = 0;
    for (int64_t i = 0; i < count; i++, a += 4, b += 4)
        most = fmax(most, scene_far(a, b) + fabs(a[3] - b[3]));
    return BETWEEN * most;
}

/* Store an interval, unless the bounds show that it is clear. */
static void consider(Way *w, int32_t from, int32_t to) {
    const double *a = w->places + 4 * w->stations * from, *b = w->places + 4 * w->stations * to;
    const double *first = w->spares + w->ranges * from, *second = w->spares + w->ranges * to;
    for (int64_t r = 0; r < w->ranges; r++) {
        int64_t count = w->scenery->ranges[r].count;
        double way = w->ways[r] * (w->shares[to] - w->shares[from]), both = first[r] + second[r];
        double chord = apart(a, b, count) + way * way / (4 * w->bends[r]);
        a += 4 * count, b += 4 * count;
        if (both - w->steep * fmin(way, chord) >= -2 * SAG) continue;
        w->stretches[w->ends++] = (Stretch){from, to};
        return;
    }
}

/* Return whether the whole way is clear; otherwise the last pose is the one that is not. */
static int go(Way *w, double *least) {
    w->count = w->ends = 0;
    for (int k = 0; k < 2; k++) {
        int outcome = look(w, k, least);
        if (outcome) return outcome;
    }
    consider(w, 0, 1);
    for (int64_t k = 0; k < w->ends; k++) {
        if (w->count == MOST_POSES) return MOTION_BLOCKED;
        Stretch now = w->stretches[k];
        int32_t middle = (int32_t)w->count;
        int outcome = look(w, (w->shares[now.from] + w->shares[now.to]) / 2, least);
        if (outcome) return outcome;
        consider(w, now.from, middle), consider(w, middle, now.to);
    }
    return MOTION_CLEAR;
}

/* Arm and scene, and memory; mirrored by `_Motions` in motion_clearance.py. */
typedef struct {
    const BodyModel *model;
    const SceneObject *objects;
    int64_t n_objects;
    const double *ends; /* (ranges, 2) of the ranges */
    const int64_t *counts;
    int64_t n_ranges;
    const double *speeds; /* (ranges, pieces), largest motion per change of a piece's pressures */
    const double *bends;  /* (ranges) */
    double *memory; /* (stiffopt_motion_memory) */
} Motions;

static int64_t stations_of(const Motions *m) {
    int64_t total = 0;
    for (int64_t r = 0; r < m->n_ranges; r++) total += m->counts[r];
    return total;
}

/* Number of doubles of the memory. */
int64_t stiffopt_motion_memory(const Motions *m) {
    return scenery_size(m->model, m->counts, m->n_ranges) +
           MOST_POSES * (1 + m->n_ranges + 4 * stations_of(m)) +
           MOST_POSES * 2 * (int64_t)sizeof(Stretch) / (int64_t)sizeof(double);
}

/* Check the motion along rows of pressures (rows, n).  found has (2 + n) numbers: the least
 * distance found, the number of poses evaluated and, if the motion is blocked, the pressures there.
 * Returns the outcome. */
int stiffopt_motions(const Motions *m, const double *pressures, int64_t rows, double asked,
                     double *found) {
    NEW_WORK(work);
    const BodyModel *model = m->model;
    Range ranges[m->n_ranges];
    Scenery a = {.work = &work, .objects = m->objects, .n_objects = m->n_objects, .ends = m->ends,
                 .ranges = ranges, .n_ranges = m->n_ranges};
    double ways[m->n_ranges], changes[model->pieces];
    Way w = {.scenery = &a, .n = model->n, .stations = stations_of(m), .ranges = m->n_ranges,
             .asked = asked, .steep = 1, .bends = m->bends, .ways = ways};
    double *memory = furnish(&a, model, m->counts, m->memory);
    w.shares = memory, memory += MOST_POSES;
    w.spares = memory, memory += MOST_POSES * w.ranges;
    w.places = memory, memory += MOST_POSES * 4 * w.stations;
    w.stretches = (Stretch *)memory;
    for (int64_t j = 0; j < m->n_objects; j++)
        if (m->objects[j].cell) w.steep = STEEPEST;
    int outcome = MOTION_CLEAR;
    found[0] = INFINITY, found[1] = 0;
    for (int64_t i = 0; i + 1 < rows && outcome == MOTION_CLEAR; i++) {
        w.from = pressures + i * w.n, w.to = w.from + w.n;
        for (int64_t k = 0; k < model->pieces; k++) changes[k] = 0;
        for (int64_t k = 0; k < w.n; k++)
            changes[model->piece_of[k]] += (w.to[k] - w.from[k]) * (w.to[k] - w.from[k]);
        for (int64_t r = 0; r < w.ranges; r++) {
            ways[r] = 0;
            for (int64_t k = 0; k < model->pieces; k++)
                ways[r] += m->speeds[r * model->pieces + k] * sqrt(changes[k]);
        }
        outcome = go(&w, found);
        found[1] += (double)w.count;
        if (outcome == MOTION_BLOCKED)
            for (int64_t k = 0; k < w.n; k++)
                found[2 + k] = w.from[k] + w.shares[w.count - 1] * (w.to[k] - w.from[k]);
    }
    return outcome;
}

#endif
