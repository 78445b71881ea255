/* The body of an arm under gravity or loads, from its equilibrium; see body.h.
 *
 * States and their changes are interpolated within integration steps by the method's dense output
 * (`stiffopt.model.body_functions.DENSE`), from the notes that rod.h stores.
 */
#ifndef STIFFOPT_LOADED_BODY_H
#define STIFFOPT_LOADED_BODY_H

#include "rod.h"

typedef struct {
    const BodyModel *model;
    const Rod *rod;
    Linear *linear;           /* with derivatives; its notes are this body's */
    double pose[12];          /* of the tip: position, axes by columns */
    double *notes;
    int64_t noted;            /* directions of the notes: 0 without derivatives */
    double *radius, *change;  /* of each piece, by each pressure */
} Body;

#define LINEAR_NUMBERS ((int64_t)((sizeof(Linear) + 7) / 8))

static int64_t body_size(const BodyModel *m) {
    const Rod *rod = m->rod;
    return LINEAR_NUMBERS + linear_size(rod) + notes_size(rod, noted_directions(rod)) + m->pieces +
           m->n;
}

static Body body_in(const BodyModel *m, double *memory) {
    const Rod *rod = m->rod;
    Body b = {.model = m, .rod = rod, .linear = (Linear *)memory};
    memory += LINEAR_NUMBERS;
    *b.linear = linear_in(rod, memory), memory += linear_size(rod);
    b.linear->notes = b.notes = memory, memory += notes_size(rod, noted_directions(rod));
    b.radius = memory, memory += m->pieces;
    b.change = memory;
    return b;
}

static int prepare_body(const Work *work, Body *b, const double *pressures, const double *state,
                        int moving) {
    work->arg[0] = pressures, work->arg[1] = b->model->numbers;
    work->res[0] = b->radius, work->res[1] = b->change;
    if (radii(work->arg, work->res, work->iw, work->w, 0)) return 0;
    b->noted = moving ? noted_directions(b->rod) : 0;
    if (!moving) {
        b->linear->known = 0; /* its notes will be overwritten */
        return tip_pose(work, b->rod, state, b->pose, b->notes);
    }
    if (!linearise(work, b->rod, state, b->linear)) return 0;
    memcpy(b->pose, b->linear->r, 3 * sizeof(double));
    return 1;
}

/* A place on the arm: its note, weights of the note's blocks, and those for the slope. */
typedef struct {
    const double *note;
    double weight[BLOCKS], slope[BLOCKS];
    int64_t blocks, directions; /* propagated to there */
} Place;

static int find_place(const Work *work, const Body *b, double s, Station *station, Place *to) {
    const Rod *rod = b->rod;
    double left = -in_piece(b->model, s, station), share;
    const RodPiece *piece = rod->piece;
    to->note = b->notes, to->directions = b->noted ? FIRST : 0;
    for (int64_t k = rod->pieces - 1;; k--, piece++) {
        int64_t steps = piece->kind < 0 ? 1 : piece->steps, step;
        if (b->noted) to->directions += piece->channels;
        if (k > station->piece) {
            to->note += steps * BLOCKS * block_size(b->noted);
            continue;
        }
        left = fmax(left + steps * piece->length, 0);
        step = (int64_t)fmin(left / piece->length, (double)(steps - 1));
        to->note += step * BLOCKS * block_size(b->noted);
        share = left / piece->length - (double)step;
        break;
    }
    to->weight[0] = 1, to->slope[0] = 0;
    to->blocks = piece->kind < 0 ? 2 : BLOCKS;
    if (piece->kind < 0) {
        to->weight[1] = share, to->slope[1] = 1;
        return 1;
    }
    work->arg[0] = &share, work->res[0] = to->weight + 1, work->res[1] = to->slope + 1;
    if (between(work->arg, work->res, work->iw, work->w, 0)) return 0;
    for (int i = 1; i < BLOCKS; i++) to->weight[i] *= piece->length;
    return 1;
}

/* Interpolate columns begin to end - 1 at a place, each (q, m, 0, r, 0): value or slope. */
static void blend(const Body *b, const Place *at, const double *weight, int64_t begin, int64_t end,
                  double *to) {
    int64_t count = 12 * (end - begin), size = block_size(b->noted);
    const double *from = at->note + 12 * begin;
    for (int64_t i = 0; i < count; i++) to[i] = weight[0] * from[i];
    for (int64_t j = 1; j < at->blocks; j++)
        for (int64_t i = 0; i < count; i++) to[i] += weight[j] * from[j * size + i];
}

/* Set a station from its state, and its turn in base axes per change of the quaternion (3, 4). */
static int put_station(const Work *work, const Body *b, const Place *at, const double *value,
                       Station *station, double *turning) {
    double slope[12], *t = station->tangent;
    blend(b, at, at->slope, 0, 1, slope);
    double length = sqrt(slope[8] * slope[8] + slope[9] * slope[9] + slope[10] * slope[10]);
    for (int i = 0; i < 3; i++)
        t[i] = slope[8 + i] / length, station->position[i] = b->pose[i] - value[8 + i];
    work->arg[0] = value, work->res[0] = station->axes, work->res[1] = turning;
    return !axes(work->arg, work->res, work->iw, work->w, 0);
}

static int station_at(const Work *work, const Body *b, double s, Station *station) {
    Place at;
    double value[12], turning[12];
    if (!find_place(work, b, s, station, &at)) return 0;
    blend(b, &at, at.weight, 0, 1, value);
    put_radius(b->model, b->radius, NULL, station, NULL);
    return put_station(work, b, &at, value, station, turning);
}

static int moving_station(const Work *work, const Body *b, double s, Station *station,
                          double *twists, double *slopes) {
    const BodyModel *m = b->model;
    const Linear *l = b->linear;
    Place at;
    double value[12 * (1 + TURNS)], own[12 * (m->n + 1)], turning[12];
    if (!find_place(work, b, s, station, &at)) return 0;
    blend(b, &at, at.weight, 0, 1 + TURNS, value);
    blend(b, &at, at.weight, 1 + FIRST, 1 + at.directions, own);
    put_radius(m, b->radius, b->change, station, slopes);
    if (!put_station(work, b, &at, value, station, turning)) return 0;
    for (int64_t k = 0; k < m->n; k++, twists += 6) {
        const double *tip = l->twist + 6 * (6 + k), *turned = l->turn + 3 * (6 + k);
        int64_t direction = direction_of(b->rod, k);
        double total[12];
        for (int i = 0; i < 12; i++) {
            total[i] = direction < at.directions ? own[12 * (direction - FIRST) + i] : 0;
            for (int j = 0; j < TURNS; j++) total[i] += turned[j] * value[12 * (1 + j) + i];
        }
        for (int i = 0; i < 3; i++) {
            twists[i] = tip[i] - total[8 + i], twists[3 + i] = 0;
            for (int j = 0; j < 4; j++) twists[3 + i] += turning[3 * j + i] * total[j];
        }
    }
    return 1;
}

/* Compute changes at a station along the first directions: of rotation (3, 9), moment (3, 9)
 * and the vector from there to the tip (3, 9), in base axes, row by row. */
static int carried_to(const Work *work, const Body *b, double s, Station *station,
                      double *carried) {
    Place at;
    double value[12 * (1 + FIRST)], turning[12];
    if (!find_place(work, b, s, station, &at)) return 0;
    blend(b, &at, at.weight, 0, 1 + FIRST, value);
    if (!put_station(work, b, &at, value, station, turning)) return 0;
    for (int i = 0; i < 3; i++)
        for (int d = 0; d < FIRST; d++) {
            const double *change = value + 12 * (1 + d);
            double turn = 0;
            for (int j = 0; j < 4; j++) turn += turning[3 * j + i] * change[j];
            carried[FIRST * i + d] = turn;
            carried[FIRST * (3 + i) + d] = change[4 + i];
            carried[FIRST * (6 + i) + d] = change[8 + i];
        }
    return 1;
}

#endif
