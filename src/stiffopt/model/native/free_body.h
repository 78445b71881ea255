/* The body of an arm without loads, in closed form; see body.h. */
#ifndef STIFFOPT_FREE_BODY_H
#define STIFFOPT_FREE_BODY_H

#include "work.h"

/* The outputs of moving_frames, or the first three of frames. */
typedef struct {
    const BodyModel *model;
    double *strain, *start, *radius; /* of each piece */
    double *slope, *twist, *change;  /* per pressure: of its piece's strain, of everything beyond
                                        that piece, of its radius */
} Body;

static int64_t body_size(const BodyModel *m) {
    return m->pieces * (m->strains + 13) + m->n * (m->strains + 7);
}

static Body body_in(const BodyModel *m, double *memory) {
    Body b = {.model = m};
    b.strain = memory, memory += m->pieces * m->strains;
    b.start = memory, memory += m->pieces * 12;
    b.radius = memory, memory += m->pieces;
    b.slope = memory, memory += m->n * m->strains;
    b.twist = memory, memory += m->n * 6;
    b.change = memory;
    return b;
}

static int prepare_body(const Work *work, Body *b, const double *pressures, const double *state,
                        int moving) {
    double margin;
    (void)state;
    work->arg[0] = pressures, work->arg[1] = b->model->numbers;
    work->res[0] = &margin, work->res[1] = b->strain, work->res[2] = b->start;
    work->res[3] = b->radius;
    work->res[4] = b->slope, work->res[5] = b->twist, work->res[6] = b->change;
    int failed = moving ? moving_frames(work->arg, work->res, work->iw, work->w, 0)
                        : frames(work->arg, work->res, work->iw, work->w, 0);
    return !failed && margin > 0;
}

/* Call along or, with `moves` (strains, 6), moving_along. */
static int find_station(const Work *work, const Body *b, double s, Station *station,
                        double *moves) {
    const BodyModel *m = b->model;
    double local = in_piece(m, s, station);
    work->arg[0] = b->start + 12 * station->piece;
    work->arg[1] = b->strain + m->strains * station->piece, work->arg[2] = &local;
    work->res[0] = (double *)station, work->res[1] = moves;
    return !(moves ? moving_along : along)(work->arg, work->res, work->iw, work->w, 0);
}

static int station_at(const Work *work, const Body *b, double s, Station *station) {
    if (!find_station(work, b, s, station, NULL)) return 0;
    put_radius(b->model, b->radius, NULL, station, NULL);
    return 1;
}

static int moving_station(const Work *work, const Body *b, double s, Station *station,
                          double *twists, double *slopes) {
    const BodyModel *m = b->model;
    double moves[6 * m->strains], *r = station->position;
    if (!find_station(work, b, s, station, moves)) return 0;
    put_radius(m, b->radius, b->change, station, slopes);
    for (int64_t k = 0; k < m->n; k++, twists += 6) {
        const double *v = b->twist + 6 * k, *w = v + 3, *slope = b->slope + m->strains * k;
        if (m->piece_of[k] < station->piece) {
            twists[0] = v[0] + w[1] * r[2] - w[2] * r[1];
            twists[1] = v[1] + w[2] * r[0] - w[0] * r[2];
            twists[2] = v[2] + w[0] * r[1] - w[1] * r[0];
            memcpy(twists + 3, w, 3 * sizeof(double));
            continue;
        }
        memset(twists, 0, 6 * sizeof(double));
        if (m->piece_of[k] == station->piece)
            for (int64_t j = 0; j < m->strains; j++)
                for (int i = 0; i < 6; i++) twists[i] += moves[6 * j + i] * slope[j];
    }
    return 1;
}

#endif
