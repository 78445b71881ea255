/* Rows of a task's program for the objects of a scene: the body's distance from each of them.
 *
 * They follow the rows of the generated functions: one for each object and segment (with its
 * connector), for a ring one for the whole arm.  A row is margin - (distance - clearance) <=
 * margin. Distances are cut off at `cutoff`; beyond it a row has no slope.
 */
#ifndef STIFFOPT_OBSTACLES_H
#define STIFFOPT_OBSTACLES_H

#include <stdlib.h>

#include "program.h"

#ifdef STIFFOPT_SCENE

#include "body.h"
#include "scene.h"

#define ROUGH_ERROR 1e-2 /* error in m of a least distance in the ranking of starts */
#define FAR_ERROR 0.3   /* allowed error, as a share of the distance beyond the clearance */

/* Mirrored by `_Obstacles` in obstacles.py. */
typedef struct {
    const BodyModel *body;
    const SceneObject *objects;
    int64_t count;           /* of objects */
    int64_t segments;
    const int64_t *ends;     /* (segments) ranges of the arm up to the end of each */
    const double *bounds;    /* (ranges, 2) arc lengths; a range is a piece of the body */
    const int64_t *stations; /* (ranges) coarse ones of each */
    double clearance, margin, cutoff;
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

/* Allocate memory for the body; return 0 if there is none. */
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

/* Move the body to pressures (Pa) and, under loads, their equilibrium. */
static int move_body(const Program *P, const double *pressures, const double *state, int moving) {
    Surroundings *around = P->around;
    const Obstacles *o = P->setup->obstacles;
    if (!prepare_body(&around->work, &around->body, pressures, state, moving)) return 0;
    for (int64_t i = 0; i < o->body->pieces; i++)
        if (!survey(&around->line, o->bounds[2 * i], o->bounds[2 * i + 1], around->ranges + i))
            return 0;
    return 1;
}

/* Compute one row and, unless J is NULL, its derivatives (n) by x. */
static int obstacle_row(const Program *P, const SceneObject *object, int64_t begin, int64_t end,
                        double *r, double *J) {
    const Setup *s = P->setup;
    const Obstacles *o = s->obstacles;
    Surroundings *around = P->around;
    Nearest nearest;
    Precision to = {o->cutoff, P->sight == ROUGH ? ROUGH_ERROR : CLEARANCE_ERROR,
                    P->sight == EXACT ? 0 : FAR_ERROR, o->clearance, P->sight == NEAR};
    if (!object_nearest_by(to, &around->line, object, around->ranges + begin, end - begin, &nearest))
        return 0;
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

/* Compute rows r and, unless J is NULL, their derivatives by x, at pressures (Pa) and, under loads,
 * their equilibrium. */
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

#else

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
