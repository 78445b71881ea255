/* The body of an arm: stations along it, and how they move with the pressures.
 *
 * Prepare a body for some pressures once, then ask for as many stations as you like:
 *
 *     double memory[body_size(model)];             (or malloc: under loads it is some 100 kB)
 *     Body body = body_in(model, memory);
 *     if (!prepare_body(&work, &body, pressures, state, 1)) ...  a law or an integration fails
 *     station_at(&work, &body, s, &station);                         where it is
 *     moving_station(&work, &body, s, &station, twists, slopes);     and derivatives by pressures
 *
 * `s` is the arc length at rest from the base in m, and is clipped to the arm.  `twists` (n, 6),
 * row by row, has for each pressure the change of the station's position and its turn, in base
 * axes per Pa; `slopes` (n) the changes of its radius.  prepare_body with 0 at the end is faster,
 * but supports only station_at.
 *
 * With STIFFOPT_LOADED defined these are for an arm under gravity or loads, and `state` is its
 * settled equilibrium (see rod.h); otherwise `state` is ignored.  Under loads the derivatives
 * come from linearise, which does nothing if `body.linear` already holds that state: a solver that
 * also needs the tip shares one Linear.  The library must contain the functions of
 * `stiffopt.model.body_functions`.
 */
#ifndef STIFFOPT_BODY_H
#define STIFFOPT_BODY_H

#include <math.h>
#include <stdint.h>
#include <string.h>

/* An arm; mirrors `BodyModel` in body.py. */
typedef struct {
    int64_t n, pieces;       /* pressures; segments and connectors, from the base */
    int64_t strains;         /* numbers of a piece's strain */
    const int64_t *piece_of; /* (n) the piece that a pressure strains */
    const int64_t *section;  /* (pieces) the piece itself; for a connector the piece before */
    const double *ends;      /* (pieces) arc lengths at rest */
    const double *numbers;   /* of the arm, see `stiffopt.model.layout` */
    const void *rod;         /* Rod, for an arm under loads */
} BodyModel;

typedef struct { /* an output of `along`, up to the tangent */
    double position[3];
    double axes[9];    /* of the section, by columns */
    double tangent[3]; /* of unit length */
    double radius;
    int64_t piece;
} Station;

/* Set the piece of arc length s; return the arc length from the start of that piece. */
static double in_piece(const BodyModel *model, double s, Station *station) {
    int64_t piece = 0;
    while (piece < model->pieces - 1 && s > model->ends[piece]) piece++;
    double start = piece ? model->ends[piece - 1] : 0;
    station->piece = piece;
    double end = model->ends[piece];
    return (s < start ? start : s > end ? end : s) - start;
}

/* Set the radius of a station and, unless slopes is NULL, its changes by pressures. */
static void put_radius(const BodyModel *model, const double *radius, const double *changes,
                       Station *station, double *slopes) {
    int64_t section = model->section[station->piece];
    station->radius = radius[section];
    for (int64_t k = 0; slopes && k < model->n; k++)
        slopes[k] = model->piece_of[k] == section ? changes[k] : 0;
}

#ifdef STIFFOPT_LOADED
#include "loaded_body.h"
#else
#include "free_body.h"
#endif

/* A prepared body, as the argument of scene.h's callback. */
typedef struct {
    const Work *work;
    const Body *body;
} BodyLine;

static int body_line_station(const void *line, double s, double *position, double *tangent,
                             double *radius) {
    const BodyLine *of = line;
    Station station;
    if (!station_at(of->work, of->body, s, &station)) return 0;
    memcpy(position, station.position, sizeof station.position);
    memcpy(tangent, station.tangent, sizeof station.tangent);
    *radius = station.radius;
    return 1;
}

#endif
