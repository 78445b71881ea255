/* Least distances of a body from objects: exact minima along ranges of arc length.
 *
 * A body is the union of spheres about its centre line.  It is given by a callback,
 *
 *     int station(const void *body, double s, double *position, double *tangent, double *radius)
 *
 * which sets position (3), unit tangent (3) and radius at an arc length s at rest, or returns 0.
 * A range is a part of the body on which the radius is constant and the tangent smooth: a
 * segment, or a connector.  For each pose, survey the ranges once, then call for each object:
 *
 *     BodyPoint points[n];
 *     Range range = {n, points};
 *     if (!survey(&line, s0, s1, &range)) ...               n >= 2 coarse stations from s0 to s1
 *     Nearest nearest;
 *     if (!object_nearest(&line, &object, ranges, count, cutoff, &nearest)) ...
 *
 * Above `cutoff` (m; INFINITY for never), nearest.distance is only known to be above it.
 * object_nearest_by does the same with another precision.  A call may be for one range (a task's
 * program has a row for each object and segment), but for a ring (`passage` is not NULL) it must be
 * for all ranges of the arm.  The change of a distance with the pressures is
 * nearest.normal . d position - nearest.radius_share d radius at nearest.s, as nearest.s is a
 * minimum or an end.  The objects hold the addresses of the formulas of `stiffopt.model.obstacles`;
 * this file needs no library of its own.  `stiffopt.model.clearance` is the same in Python.
 */
#ifndef STIFFOPT_SCENE_H
#define STIFFOPT_SCENE_H

#include <math.h>
#include <stdint.h>

enum { SCENE_MEMORY = 64, MOST_PARAMETERS = 32 };
enum { CONVEX, CONCAVE, ANY_COURSE };

#define CLEARANCE_ERROR 4e-6 /* m, largest error of a least distance */
#define SHORTEST 1e-6        /* m of arc length; shorter intervals are not divided */
#define FINE 3e-4            /* m of arc length, below which any object is treated as convex */
#define IN_PLANE 1e-9        /* m; heights above a ring's plane below this count as zero */
#define SHARPENED 1e-4       /* m of arc length, over which a slope's change is measured */
#define LEVEL 1e-9           /* m, tolerance of settle_at_minimum, */
#define NOT_LEVEL 1e-3       /* plus this share of the distance beyond what is asked */
#define MOST_TURNS 8         /* iterations of settle_at_minimum */
#define STEEPEST 1.5         /* largest gradient of an interpolated distance */
#define MORE_CURVED 1.35     /* bound on the curvature, over that of the coarse stations */

typedef int (*Formula)(const double **arg, double **res, long long int *iw, double *w, int mem);
typedef int (*StationOf)(const void *body, double s, double *position, double *tangent,
                         double *radius);

/* Mirrored by `SceneObjectInC` in distances.py. */
typedef struct {
    Formula distance; /* (point, parameters of a piece) to the distance and its gradient (3) */
    Formula cell;     /* for a grid: to the cube of a point (3); otherwise NULL */
    Formula passage;  /* for a ring: to height, excess, distance of the disc, its gradient */
    int64_t course;   /* of the distance along a straight line */
    int64_t pieces, size;     /* the largest of the pieces' distances counts */
    double begin;             /* arc length at rest in the first range, from which the body counts */
    const double *parameters; /* (pieces, size) */
    const float *const *grids;
    const int64_t *shapes; /* (pieces, 3) of the grids */
} SceneObject;

typedef struct {
    double s, position[3], tangent[3], radius;
} BodyPoint;

/* `speed`: largest arc length per arc length at rest; `turn`: largest change of the tangent per the
 * same. */
typedef struct {
    int64_t count;
    BodyPoint *points;
    double speed, turn;
} Range;

typedef struct {
    StationOf station;
    const void *body;
} CentreLine;

/* Mirrored by `Nearest` in clearance.py. */
typedef struct {
    double distance, s, radius_share, position[3], normal[3];
} Nearest;

typedef struct {
    const BodyPoint *point;
    double value, slope, normal[3];
    int64_t piece;
} Probe;

/* Upper bounds `most` (pieces) on the pieces' distances at the last point, from which others
 * follow, as a distance changes by no more than the path.  `nearest` is the piece of the largest
 * there. */
typedef struct {
    double point[3], *most;
    int64_t nearest;
} PieceBounds;

/* Allowed error of a least distance: `error`, plus a share of the distance beyond `asked`. */
typedef struct {
    double cutoff, error, share, asked;
    int settled; /* whether the normal must be the gradient of the least distance */
} Precision;

typedef struct {
    const CentreLine *line;
    const SceneObject *object;
    const Range *range;
    Precision to;
    Nearest *best;
    double slope;        /* at the best */
    const Range *within; /* the range of the best */
    PieceBounds bounds;
} NearestSearch;

/* Faster than calls of fmax and fmin. */
static double larger(double a, double b) { return a > b ? a : b; }
static double smaller(double a, double b) { return a < b ? a : b; }

static double scene_dot(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static double scene_far(const double *a, const double *b) {
    double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return sqrt(scene_dot(d, d));
}

/* -- objects ------------------------------------------------------------------------------ */

/* Store the values at the corners of a point's cube after the other parameters. */
static int put_corners(const SceneObject *o, int64_t piece, const double *point, double *q) {
    double cell[3], w[SCENE_MEMORY];
    const double *arg[2] = {point, q};
    double *res[1] = {cell};
    const int64_t *shape = o->shapes + 3 * piece;
    if (o->cell(arg, res, 0, w, 0)) return 0;
    for (int k = 0; k < 3; k++)
        if (!(cell[k] >= 0 && cell[k] <= (double)(shape[k] - 2))) return 0;
    const float *from = o->grids[piece] +
        ((int64_t)cell[0] * shape[1] + (int64_t)cell[1]) * shape[2] + (int64_t)cell[2];
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++)
            for (int k = 0; k < 2; k++)
                q[o->size - 8 + 4 * i + 2 * j + k] = from[(i * shape[1] + j) * shape[2] + k];
    return 1;
}

/* Compute the distance of a point from one piece, and its gradient. */
static int piece_distance(const SceneObject *o, int64_t piece, const double *point,
                          double *distance, double *gradient) {
    double w[SCENE_MEMORY], with_corners[MOST_PARAMETERS];
    const double *q = o->parameters + piece * o->size;
    if (o->cell) {
        for (int64_t k = 0; k < o->size; k++) with_corners[k] = q[k];
        if (!put_corners(o, piece, point, with_corners)) return 0;
        q = with_corners;
    }
    const double *arg[2] = {point, q};
    double *res[2] = {distance, gradient};
    return !o->distance(arg, res, 0, w, 0) && isfinite(*distance);
}

static PieceBounds no_bounds(const SceneObject *o, double *most) {
    for (int64_t i = 0; i < o->pieces; i++) most[i] = INFINITY;
    return (PieceBounds){.most = most};
}

/* Largest gradient of a distance. */
static double steepest(const SceneObject *o) { return o->cell ? STEEPEST : 1; }

/* Compute the distance of a point from an object, its gradient, and its piece; pieces that cannot
 * have the largest distance are skipped. */
static int object_distance(const SceneObject *o, PieceBounds *bounds, const double *point,
                           double *distance, double *normal, int64_t *nearest) {
    if (o->pieces == 1) return *nearest = 0, piece_distance(o, 0, point, distance, normal);
    double way = steepest(o) * scene_far(point, bounds->point), value, gradient[3];
    int64_t first = bounds->nearest;
    *distance = -INFINITY;
    for (int64_t k = 0; k < o->pieces; k++) {
        int64_t i = k == 0 ? first : k <= first ? k - 1 : k;
        bounds->most[i] += way;
        if (bounds->most[i] <= *distance) continue;
        if (!piece_distance(o, i, point, &value, gradient)) return 0;
        bounds->most[i] = value;
        if (value <= *distance) continue;
        *distance = value, *nearest = i;
        for (int j = 0; j < 3; j++) normal[j] = gradient[j];
    }
    bounds->nearest = *nearest;
    for (int j = 0; j < 3; j++) bounds->point[j] = point[j];
    return 1;
}

/* -- the body ----------------------------------------------------------------------------- */

static int body_point(const CentreLine *line, double s, BodyPoint *p) {
    p->s = s;
    return line->station(line->body, s, p->position, p->tangent, &p->radius);
}

/* Compute the coarse stations of a range, and bounds on its speed and turn. */
static int survey(const CentreLine *line, double s0, double s1, Range *range) {
    BodyPoint *p = range->points;
    int64_t n = range->count;
    for (int64_t i = 0; i < n; i++)
        if (!body_point(line, i == n - 1 ? s1 : s0 + (s1 - s0) * (double)i / (double)(n - 1), p + i))
            return 0;
    range->speed = range->turn = 0;
    for (int64_t i = 0; i + 1 < n; i++, p++) {
        double step = p[1].s - p->s, half = scene_far(p[1].tangent, p->tangent) / 2;
        double bent = half > 1e-6 ? asin(smaller(half, 1)) / smaller(half, 1) : 1; /* arc over chord */
        range->speed = larger(range->speed, bent * scene_far(p[1].position, p->position) / step);
        range->turn = larger(range->turn, 2 * half * bent / step);
    }
    return 1;
}

/* Restrict a range to arc lengths from object->begin on; `points` is memory for its stations. */
static int counted_range(const CentreLine *line, const SceneObject *object, const Range *range,
                         BodyPoint *points, Range *counted) {
    const BodyPoint *p = range->points;
    *counted = *range;
    if (p->s >= object->begin) return 1;
    double s = smaller(object->begin, p[range->count - 1].s);
    counted->points = points, counted->count = 1;
    for (int64_t i = 0; i < range->count; i++)
        if (p[i].s > s) points[counted->count++] = p[i];
    return body_point(line, s, points);
}

/* -- minima along a range ------------------------------------------------------------------ */

static int probe_at(NearestSearch *search, const BodyPoint *point, Probe *probe) {
    Nearest *best = search->best;
    double distance;
    if (!object_distance(search->object, &search->bounds, point->position, &distance, probe->normal,
                         &probe->piece))
        return 0;
    probe->point = point;
    probe->value = distance - point->radius;
    probe->slope = search->range->speed * scene_dot(probe->normal, point->tangent);
    if (probe->value >= best->distance) return 1;
    best->distance = probe->value, best->s = point->s, best->radius_share = 1;
    search->slope = probe->slope, search->within = search->range;
    for (int k = 0; k < 3; k++)
        best->position[k] = point->position[k], best->normal[k] = probe->normal[k];
    return 1;
}

static double to_beat(const NearestSearch *search) {
    const Precision *to = &search->to;
    double least = smaller(search->best->distance, to->cutoff);
    return least - larger(to->error, to->share * (least - to->asked));
}

/* Largest slope of a distance along the arc length at rest. */
static double steepness(const NearestSearch *search) {
    return search->range->speed * steepest(search->object);
}

/* Lower bound of the distance from the chord between two points to an object that has these
 * distances from them: that of the circle in which the two spheres meet. */
static double outside_spheres(double chord, double first, double second) {
    double x = (chord * chord + first * first - second * second) / (2 * chord);
    if (x <= 0) return first;
    return x >= chord ? second : sqrt(larger(first * first - x * x, 0));
}

/* Minimum of the larger of two linear functions: one from a0 to b0, the larger at the start, the
 * other from a1 to b1, the larger at the end. */
static double least_larger(double a0, double b0, double a1, double b1) {
    double crossing = a0 - a1 + b1 - b0;
    double there = crossing > 0 ? a0 + (b0 - a0) * (a0 - a1) / crossing : a0;
    return smaller(smaller(a0, b1), there);
}

/* The same between two probes, for the pieces with the largest distance at each. */
static double least_of_pieces(const NearestSearch *search, const Probe *a, const Probe *b) {
    double of_b_at_a, of_a_at_b, unused[3];
    if (a->piece == b->piece) return smaller(a->value, b->value);
    if (!piece_distance(search->object, b->piece, a->point->position, &of_b_at_a, unused) ||
        !piece_distance(search->object, a->piece, b->point->position, &of_a_at_b, unused))
        return -INFINITY;
    return least_larger(a->value, of_a_at_b - b->point->radius, of_b_at_a - a->point->radius, b->value);
}

/* Lower bound of the distance between two probes, h apart in arc length.
 *
 * Several bounds hold; the largest is used.  The distance changes by no more than the path.
 * Between two points outside an object it changes by less, as the object is outside the spheres
 * about both (outside_spheres); with speed v and curvature c, the centre line is within m h^2 / 8
 * of its chord, m = v^2 c.  If the distance is convex along straight lines, its second derivative
 * along the centre line is at least -m: less m u (h - u) / 2, it is convex, equal at both ends, and
 * above its tangents there.  If it is concave in each piece, each piece's distance is at most m h^2
 * / 8 below its chord, and the object's is the largest of them. */
static double least_between(const NearestSearch *search, const Probe *a, const Probe *b) {
    const Range *range = search->range;
    int64_t course = search->object->course;
    double h = b->point->s - a->point->s;
    double least = (a->value + b->value - steepness(search) * h) / 2;
    double m = MORE_CURVED * range->speed * range->turn;
    if (least >= to_beat(search)) return least;
    if (course == CONCAVE) return larger(least, least_of_pieces(search, a, b) - m * h * h / 8);
    double first = a->value + a->point->radius, second = b->value + b->point->radius;
    if (course == ANY_COURSE && first > 0 && second > 0) {
        double chord = scene_far(a->point->position, b->point->position);
        double found = outside_spheres(chord, first, second) - m * h * h / 8;
        least = larger(least, found - larger(a->point->radius, b->point->radius));
    }
    if (course != CONVEX && h > FINE) return least;
    double down = a->slope - m * h / 2, up = b->slope + m * h / 2;
    if (down >= 0) return larger(least, a->value);
    if (up <= 0) return larger(least, b->value);
    double u = (b->value - a->value - up * h) / (down - up);
    return larger(least, a->value + down * smaller(larger(u, 0), h));
}

/* Divide the interval between two probes as long as it may contain a smaller distance. */
static int refine_between(NearestSearch *search, const Probe *a, const Probe *b) {
    double h = b->point->s - a->point->s, share = 0.5;
    if (h < SHORTEST || least_between(search, a, b) >= to_beat(search)) return 1;
    if (a->slope < 0 && b->slope > 0)
        share = smaller(larger(a->slope / (a->slope - b->slope), 0.1), 0.9);
    BodyPoint middle;
    Probe probe;
    return body_point(search->line, a->point->s + share * h, &middle) &&
        probe_at(search, &middle, &probe) && refine_between(search, a, &probe) &&
        refine_between(search, &probe, b);
}

/* Search a range for a distance less than the best so far. */
static int search_range(NearestSearch *search, const Range *range) {
    int64_t n = range->count, used = 0;
    const BodyPoint *p = range->points;
    Probe probes[n];
    search->range = range;
    if (!probe_at(search, p, probes)) return 0;
    for (int64_t i = 1; i < n; i++) {
        double reach = steepness(search) * (p[i].s - probes[used].point->s);
        if (i < n - 1 && probes[used].value - reach > to_beat(search)) continue; /* too far away */
        if (!probe_at(search, p + i, probes + ++used)) return 0;
    }
    for (int64_t i = 0; i < used; i++)
        if (!refine_between(search, probes + i, probes + i + 1)) return 0;
    return 1;
}

/* Find a probe near the best at which the slope has the other sign; return 0 without one. */
static int probe_beyond(NearestSearch *search, const Probe *from, BodyPoint *point, Probe *probe) {
    const Range *range = search->range;
    double low = range->points[0].s, high = range->points[range->count - 1].s;
    double step = from->slope > 0 ? -SHARPENED : SHARPENED;
    for (int turn = 0; turn < 3; turn++, step *= 4) {
        double s = smaller(larger(from->point->s + step, low), high);
        if (!body_point(search->line, s, point) || !probe_at(search, point, probe)) return 0;
        if (from->slope * probe->slope < 0) return 1;
        if (s == low || s == high) return 0;
    }
    return 0;
}

/* Move the best to its minimum along the body, which may be a kink, and replace its normal by the
 * gradient of the least distance when the body moves.
 *
 * If the nearest piece, or cube of a grid, changes at the minimum s, two normals meet there.  As s
 * moves too, the gradient is their weighted mean whose slope along the body is zero. */
static int settle_at_minimum(NearestSearch *search) {
    Nearest *best = search->best;
    BodyPoint points[3];
    Probe first, second, middle, *a = &first, *b = &second;
    search->range = search->within;
    if (best->distance >= search->to.cutoff || search->slope == 0) return 1;
    if (!body_point(search->line, best->s, points) || !probe_at(search, points, a)) return 0;
    if (!probe_beyond(search, a, points + 1, b)) return 1;
    for (int turn = 0; turn < MOST_TURNS; turn++) {
        double h = b->point->s - a->point->s;
        double meeting = (b->value - a->value - b->slope * h) / (a->slope - b->slope); /* of tangents */
        double gap = smaller(a->value, b->value) - a->value - a->slope * meeting;
        if (fabs(gap) < LEVEL + NOT_LEVEL * (best->distance - search->to.asked)) break;
        double way = turn % 2 ? meeting : h * a->slope / (a->slope - b->slope);
        BodyPoint *other = points + 2;
        if (!(way / h > 0 && way / h < 1)) break;
        if (!body_point(search->line, a->point->s + way, other) || !probe_at(search, other, &middle))
            return 0;
        Probe *to = middle.slope * a->slope > 0 ? a : b;
        BodyPoint *at = to->point == points ? points : points + 1;
        *at = *other, *to = middle, to->point = at;
    }
    for (int k = 0; k < 3; k++)
        best->normal[k] = (b->slope * a->normal[k] - a->slope * b->normal[k]) / (b->slope - a->slope);
    return 1;
}

/* Move the best to where the slope is zero, so that its normal is accurate to first order too. */
static int sharpen(NearestSearch *search) {
    if (search->to.settled) return settle_at_minimum(search);
    const Range *range = search->range = search->within;
    double low = range->points[0].s, high = range->points[range->count - 1].s;
    double s = search->best->s, slope = search->slope, step = slope > 0 ? -SHARPENED : SHARPENED;
    BodyPoint point;
    Probe probe;
    if (search->best->distance >= search->to.cutoff || s + step <= low || s + step >= high) return 1;
    if (!body_point(search->line, s + step, &point) || !probe_at(search, &point, &probe)) return 0;
    step *= slope / (slope - probe.slope);
    if (!(fabs(step) < FINE) || s + step <= low || s + step >= high) return 1;
    return body_point(search->line, s + step, &point) && probe_at(search, &point, &probe);
}

/* -- rings --------------------------------------------------------------------------------- */

typedef struct {
    double height, beyond, from_disc, normal[3];
} Passage;

static int passage_of(const SceneObject *o, const double *point, Passage *passage) {
    double w[SCENE_MEMORY];
    const double *arg[2] = {point, o->parameters};
    double *res[4] = {&passage->height, &passage->beyond, &passage->from_disc, passage->normal};
    if (o->passage(arg, res, 0, w, 0)) return 0;
    if (fabs(passage->height) < IN_PLANE) passage->height = 0;
    return 1;
}

/* Find whether the centre line crosses the disc between two points. */
static int passes_between(const CentreLine *line, const SceneObject *o, const BodyPoint *a,
                          const BodyPoint *b, Passage low, Passage high, int *inside) {
    double s0 = a->s, s1 = b->s;
    Passage middle = low;
    for (int i = 0; i < 60 && s1 - s0 > SHORTEST; i++) {
        BodyPoint p;
        double share = low.height / (low.height - high.height);
        share = i % 2 ? 0.5 : smaller(larger(share, 0.01), 0.99);
        if (!body_point(line, s0 + share * (s1 - s0), &p) || !passage_of(o, p.position, &middle))
            return 0;
        if ((middle.height <= 0) == (low.height <= 0)) s0 = p.s, low = middle;
        else s1 = p.s, high = middle;
    }
    *inside = middle.beyond <= 0;
    return 1;
}

/* Find whether the centre line crosses the plane of a ring, and the ring; `last` is its tip. */
static int passes(const CentreLine *line, const SceneObject *o, const Range *ranges, int64_t count,
                  int *crossed, int *passed, Passage *last) {
    const BodyPoint *before = NULL;
    Passage now;
    *crossed = *passed = 0, *last = (Passage){0};
    for (int64_t r = 0; r < count; r++)
        for (int64_t i = 0; i < ranges[r].count; before = ranges[r].points + i++, *last = now) {
            const BodyPoint *point = ranges[r].points + i;
            if (!passage_of(o, point->position, &now)) return 0;
            if (!before || now.height == 0 || last->height * now.height > 0) continue;
            int inside = last->height == 0 && last->beyond <= 0;
            if (last->height != 0 &&
                !passes_between(line, o, before, point, *last, now, &inside))
                return 0;
            *crossed = 1, *passed ^= inside;
        }
    return 1;
}

/* Compute a ring's distance, that of its circle; negative if the centre line passes outside. */
static int ring_nearest(NearestSearch *search, const Range *ranges, int64_t count) {
    Nearest *best = search->best;
    int crossed, passed;
    Passage tip;
    if (!passes(search->line, search->object, ranges, count, &crossed, &passed, &tip)) return 0;
    if (!crossed) {
        const Range *last = ranges + count - 1;
        const BodyPoint *end = last->points + last->count - 1;
        best->distance = -tip.from_disc, best->s = end->s, best->radius_share = 0;
        for (int k = 0; k < 3; k++)
            best->position[k] = end->position[k], best->normal[k] = -tip.normal[k];
        return 1;
    }
    if (!passed) search->to.cutoff = INFINITY, search->to.share = 0;
    for (int64_t r = 0; r < count; r++)
        if (!search_range(search, ranges + r)) return 0;
    if (!sharpen(search)) return 0;
    if (passed) return 1;
    BodyPoint nearest;
    if (!body_point(search->line, best->s, &nearest)) return 0;
    best->distance = -best->distance - 2 * nearest.radius;
    for (int k = 0; k < 3; k++) best->normal[k] = -best->normal[k];
    return 1;
}

/* Find the point nearest to an object along surveyed ranges. */
static int object_nearest_by(Precision to, const CentreLine *line, const SceneObject *object,
                             const Range *ranges, int64_t count, Nearest *nearest) {
    double most[object->pieces];
    NearestSearch search = {line, object, ranges, to, nearest, 0, ranges, no_bounds(object, most)};
    nearest->distance = INFINITY;
    if (object->passage) return ring_nearest(&search, ranges, count);
    BodyPoint points[ranges->count];
    Range first;
    if (!counted_range(line, object, ranges, points, &first)) return 0;
    for (int64_t r = 0; r < count; r++)
        if (!search_range(&search, r ? ranges + r : &first)) return 0;
    return sharpen(&search);
}

static int object_nearest(const CentreLine *line, const SceneObject *object, const Range *ranges,
                          int64_t count, double cutoff, Nearest *nearest) {
    Precision to = {cutoff, CLEARANCE_ERROR, 0, 0, 0};
    return object_nearest_by(to, line, object, ranges, count, nearest);
}

#endif
