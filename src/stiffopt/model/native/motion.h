/* Whether the body of an arm stays clear of a scene while its pressures go straight from one row to
 * the next: adaptive, and for all that is between the poses that are looked at.
 *
 * Each range of the body is judged by itself, as what is near to the base moves little.  Between two
 * poses in which it has distances d0 and d1, of which no point of it is further apart than c and
 * leaves its chord by more than e on its way, its distance is at least (d0 + d1 - c) / 2 - e.  With
 * `way` the most that it moves (see speeds below) another bound is (d0 + d1 - way) / 2; and e <=
 * way^2 / (8 bend), as the second derivative along a way is at most its speed^2 / bend.
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
    double *spares;          /* (MOST_POSES, ranges), distances beyond what is asked */
    double *places;          /* (MOST_POSES, stations, 4): positions and radii */
    Stretch *stretches;      /* (2 MOST_POSES) */
} Way;

/* What an object leaves each range to spare; of a ring, that the arm passes through. */
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

/* Look at a share of the way, and note the pose; the least distance is exact if it matters. */
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

/* The most that a range with these stations is apart in two poses. */
static double apart(const double *a, const double *b, int64_t count) {
    double most = 0;
    for (int64_t i = 0; i < count; i++, a += 4, b += 4)
        most = fmax(most, scene_far(a, b) + fabs(a[3] - b[3]));
    return BETWEEN * most;
}

/* Note a stretch, unless it is clear as it is. */
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

/* Whether all is clear on the way; the last pose is the one that is not. */
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

/* What is judged, and memory for it; mirrored by `_Motions` in motion_clearance.py. */
typedef struct {
    const BodyModel *model;
    const SceneObject *objects;
    int64_t n_objects;
    const double *ends; /* (ranges, 2) of the ranges */
    const int64_t *counts;
    int64_t n_ranges;
    const double *speeds; /* (ranges, pieces), the most that it moves per change of their pressures */
    const double *bends;  /* (ranges) */
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
           MOST_POSES * (1 + m->n_ranges + 4 * stations_of(m)) +
           MOST_POSES * 2 * (int64_t)sizeof(Stretch) / (int64_t)sizeof(double);
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
