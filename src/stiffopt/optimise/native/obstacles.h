/* Rows of a task's program for the objects of a scene: how far the body is from each of them.
 *
 * After the rows of the generated functions there is one for each object and segment (with its
 * connector), of a ring one for the whole arm: margin - (distance - clearance), bounded on one side
 * by `margin`.  Where the body is further away than `cutoff`, a row says no more than that, and has
 * no slope.
 */
#ifndef STIFFOPT_OBSTACLES_H
#define STIFFOPT_OBSTACLES_H

#include <stdlib.h>

#include "program.h"

#ifdef STIFFOPT_SCENE

#include "body.h"
#include "scene.h"

#define QUICK_TURNS 8   /* of looking closer */
#define QUICK_ERROR 1e-6 /* m of the least distance, at which that ends */
#define QUICK_NEAR 4e-3  /* m above the clearance, from which it is worth it */

/* Mirrored by `_Obstacles` in obstacles.py. */
typedef struct {
    const BodyModel *body;
    const SceneObject *objects;
    int64_t count;           /* of objects */
    int64_t segments;
    const int64_t *ends;     /* (segments) ranges of the arm up to the end of each */
    const double *bounds;    /* (ranges, 2) arc lengths; a range is a piece of the body */
    const int64_t *stations; /* (ranges) coarse ones of each */
    double clearance, margin, cutoff, allowed;
} Obstacles;

/* The body among the objects, at the pressures of the last evaluation. */
typedef struct {
    Work work;
    Body body;
    CentreLine line;
    Range *ranges;            /* (pieces) */
    double *twists, *slopes;  /* (n, 6), (n) of a station */
} Surroundings;

static int station_of_body(const void *of, double s, double *position, double *tangent,
                           double *radius) {
    const Surroundings *around = of;
    Station station;
    if (!station_at(&around->work, &around->body, s, &station)) return 0;
    memcpy(position, station.position, sizeof station.position);
    memcpy(tangent, station.tangent, sizeof station.tangent);
    *radius = station.radius;
    return 1;
}

/* Memory for the body; 0 where there is none. */
static int add_surroundings(Program *P) {
    const Obstacles *o = P->setup->obstacles;
    const BodyModel *model = o->body;
    int64_t stations = 0, numbers = body_size(model) + 7 * model->n;
    for (int64_t i = 0; i < model->pieces; i++) stations += o->stations[i];
    Surroundings *around =
        malloc(sizeof *around + (size_t)numbers * sizeof(double) +
               (size_t)model->pieces * sizeof(Range) + (size_t)stations * sizeof(BodyPoint));
    if (!around) return 0;
    double *memory = (double *)(around + 1);
    around->work = (Work){P->arg, P->res, P->iw, P->w};
    around->body = body_in(model, memory), memory += body_size(model);
    around->line = (CentreLine){station_of_body, around};
    around->twists = memory, memory += 6 * model->n;
    around->slopes = memory, memory += model->n;
    around->ranges = (Range *)memory;
    BodyPoint *points = (BodyPoint *)(around->ranges + model->pieces);
    for (int64_t i = 0; i < model->pieces; points += o->stations[i++])
        around->ranges[i] = (Range){.count = o->stations[i], .points = points};
    P->around = around;
#ifdef STIFFOPT_LOADED
    P->linear = around->body.linear;
#endif
    return 1;
}

/* Bring the body to pressures (Pa) and, under loads, their equilibrium. */
static int move_body(const Program *P, const double *pressures, const double *state, int moving) {
    Surroundings *around = P->around;
    const Obstacles *o = P->setup->obstacles;
    if (!prepare_body(&around->work, &around->body, pressures, state, moving)) return 0;
    for (int64_t i = 0; i < o->body->pieces; i++)
        if (!survey(&around->line, o->bounds[2 * i], o->bounds[2 * i + 1], around->ranges + i))
            return 0;
    return 1;
}

/* A station with its distance from an object, and how that changes with arc length at rest. */
typedef struct {
    BodyPoint point;
    double value, slope, normal[3];
} Look;

static int look_at(const SceneObject *object, const Range *range, const BodyPoint *point, Look *to) {
    int64_t piece;
    to->point = *point;
    if (!object_distance(object, point->position, &to->value, to->normal, &piece)) return 0;
    to->value -= point->radius;
    to->slope = range->speed * scene_dot(to->normal, point->tangent);
    return 1;
}

/* The nearest point by the coarse stations alone, then where the slope vanishes next to the nearest
 * of them: what object_nearest finds, but for a second minimum that is nearly as low. */
static int quickly_nearest(const Surroundings *around, const SceneObject *object, int64_t begin,
                           int64_t end, double cutoff, double near, Nearest *nearest) {
    Look best, look, other;
    const Range *in = NULL;
    int64_t index = 0;
    best.value = INFINITY;
    for (int64_t k = begin; k < end; k++) {
        const Range *range = around->ranges + k;
        double skip = -INFINITY;
        for (int64_t i = 0; i < range->count; i++) {
            const BodyPoint *point = range->points + i;
            if (point->s < skip && i + 1 < range->count) continue;
            if (!look_at(object, range, point, &look)) return 0;
            /* within this way nothing is nearer than what was seen, or matters */
            skip = point->s + (look.value - fmin(best.value, cutoff)) / range->speed;
            if (look.value < best.value) best = look, in = range, index = i;
        }
    }
    int64_t next = best.slope < 0 ? index + 1 : index - 1;
    if (best.value < near && next >= 0 && next < in->count) {
        if (!look_at(object, in, in->points + next, &other)) return 0;
        Look edge = best;
        for (int turn = 0; turn < QUICK_TURNS && edge.slope * other.slope < 0; turn++) {
            BodyPoint middle;
            double share = fmin(fmax(edge.slope / (edge.slope - other.slope), 0.05), 0.95);
            double s = edge.point.s + share * (other.point.s - edge.point.s);
            if (!body_point(&around->line, s, &middle) || !look_at(object, in, &middle, &look)) return 0;
            if (look.value < best.value) best = look;
            double curved = (edge.slope - other.slope) / (edge.point.s - other.point.s);
            if (look.slope * look.slope < 2 * fabs(curved) * QUICK_ERROR) break;
            if (look.slope * edge.slope > 0) edge = look;
            else other = look;
        }
    }
    nearest->distance = best.value, nearest->s = best.point.s, nearest->radius_share = 1;
    memcpy(nearest->normal, best.normal, sizeof nearest->normal);
    return 1;
}

/* The same of a ring, by the straight lines between coarse stations; see ring_nearest. */
static int ring_quickly_nearest(const Surroundings *around, const SceneObject *object, int64_t end,
                                double near, Nearest *nearest) {
    const BodyPoint *last = NULL;
    Passage before = {0}, at;
    int crossed = 0, passed = 0;
    for (int64_t k = 0; k < end; k++)
        for (int64_t i = 0; i < around->ranges[k].count; i++) {
            const BodyPoint *point = around->ranges[k].points + i;
            if (!passage_of(object, point->position, &at)) return 0;
            if (last && (before.height <= 0) != (at.height <= 0)) {
                double share = before.height / (before.height - at.height), position[3];
                Passage there;
                for (int j = 0; j < 3; j++)
                    position[j] = last->position[j] + share * (point->position[j] - last->position[j]);
                if (!passage_of(object, position, &there)) return 0;
                crossed = 1, passed ^= there.beyond <= 0;
            }
            before = at, last = point;
        }
    if (!crossed) {
        nearest->distance = -at.from_disc, nearest->s = last->s, nearest->radius_share = 0;
        for (int j = 0; j < 3; j++) nearest->normal[j] = -at.normal[j];
        return 1;
    }
    if (!quickly_nearest(around, object, 0, end, INFINITY, passed ? near : INFINITY, nearest)) return 0;
    if (passed) return 1;
    BodyPoint point;
    if (!body_point(&around->line, nearest->s, &point)) return 0;
    nearest->distance = -nearest->distance - 2 * point.radius;
    for (int j = 0; j < 3; j++) nearest->normal[j] = -nearest->normal[j];
    return 1;
}

/* One row and, unless J is NULL, its derivatives (n) by x. */
static int obstacle_row(const Program *P, const SceneObject *object, int64_t begin, int64_t end,
                        double *r, double *J) {
    const Setup *s = P->setup;
    const Obstacles *o = s->obstacles;
    Surroundings *around = P->around;
    Nearest nearest;
    double near = P->sight == ROUGH ? -INFINITY : o->clearance + QUICK_NEAR;
    int found;
    if (P->sight == EXACT)
        found = object_nearest(&around->line, object, around->ranges + begin, end - begin,
                               o->cutoff, &nearest);
    else if (object->passage)
        found = ring_quickly_nearest(around, object, end, near, &nearest);
    else
        found = quickly_nearest(around, object, begin, end, o->cutoff, near, &nearest);
    if (!found) return 0;
    *r = o->margin - (fmin(nearest.distance, o->cutoff) - o->clearance);
    if (!J) return 1;
    memset(J, 0, (size_t)s->n * sizeof(double));
    if (nearest.distance >= o->cutoff) return 1;
    Station station;
    if (!moving_station(&around->work, &around->body, nearest.s, &station, around->twists,
                        around->slopes))
        return 0;
    for (int64_t i = 0; i < s->n; i++)
        J[i] = -s->unit[i] * (dot(nearest.normal, around->twists + 6 * i, 3) -
                              nearest.radius_share * around->slopes[i]);
    return 1;
}

/* Rows r and, unless J is NULL, their derivatives by x, at pressures (Pa) and, under loads, their
 * equilibrium. */
static int put_obstacles(const Program *P, const double *pressures, const double *state,
                         double *r, double *J) {
    const Obstacles *o = P->setup->obstacles;
    int64_t count = P->setup->rows - P->setup->own_rows;
    if (!o || P->sight == KNOWN) return 1;
    if (J && P->sight == ROUGH) {
        memset(J, 0, (size_t)(count * P->setup->n) * sizeof(double));
        J = NULL;
    }
    if (!move_body(P, pressures, state, J != NULL)) return 0;
    for (int64_t i = 0; i < o->count; i++) {
        const SceneObject *object = o->objects + i;
        int64_t rows = object->passage ? 1 : o->segments, begin = 0;
        for (int64_t k = 0; k < rows; k++) {
            int64_t end = o->ends[object->passage ? o->segments - 1 : k];
            if (!obstacle_row(P, object, begin, end, r++, J)) return 0;
            if (J) J += P->setup->n;
            begin = end;
        }
    }
    return 1;
}

/* Whether rows say that the body keeps the clearance. */
static int is_clear(const Program *P, const double *rows) {
    const Obstacles *o = P->setup->obstacles;
    for (int64_t i = 0; i < P->setup->rows - P->setup->own_rows; i++)
        if (!(rows[i] <= o->margin + o->allowed)) return 0;
    return 1;
}

#else

static int is_clear(const Program *P, const double *rows) {
    (void)P, (void)rows;
    return 1;
}

static int add_surroundings(Program *P) {
    P->around = NULL;
    return 1;
}

static int put_obstacles(const Program *P, const double *pressures, const double *state,
                         double *r, double *J) {
    (void)P, (void)pressures, (void)state, (void)r, (void)J;
    return 1;
}

#endif

#endif
