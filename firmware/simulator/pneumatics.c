#include "pneumatics.h"

#include <math.h>
#include <string.h>

#define ATMOSPHERE 1.0132
#define CRITICAL 0.3 // of the valves; ISO 6358
#define NORMAL 1.0   // bar, of the dm3 that flow

void pneumatics_init(struct pneumatics *p, int channels, double supply_gauge, double volume) {
    memset(p, 0, sizeof *p);
    p->channels = channels;
    p->source = supply_gauge + ATMOSPHERE;
    p->source_flow = 0.5;
    p->line_volume = 0.1;
    p->valve_flow = 0.2;
    p->valve_lag = 0.005;
    p->tube_flow = 0.5;
    p->dead_volume = 0.002;
    p->cracking = 0.02;
    p->line = ATMOSPHERE;
    for (int i = 0; i < MOST; i++) {
        p->volume[i] = volume;
        p->node[i] = p->chamber[i] = ATMOSPHERE;
        p->exhaust[i] = channels == MOST; // a 3-way valve that is off
    }
}

static double flow(double conductance, double p1, double p2) { // normal dm3/s, signed
    if (p1 < p2) return -flow(conductance, p2, p1);
    double ratio = p2 / p1;
    if (ratio <= CRITICAL) return conductance * p1;
    double x = (ratio - CRITICAL) / (1 - CRITICAL);
    return conductance * p1 * sqrt(1 - x * x);
}

static double share(double duty, double begins, double full) {
    double opening = (duty * 255 - begins) / (full - begins);
    return opening < 0 ? 0 : opening > 1 ? 1 : opening;
}

static void move_valves(struct pneumatics *p, double dt, const double duty[MOST]) {
    bool pairs = p->channels < MOST;
    for (int i = 0; i < p->channels; i++) {
        double fill = pairs ? share(duty[2 * i], 80 - p->offset, 230 - p->offset)
                            : share(duty[i], 140 - p->offset, 240 - p->offset);
        double exhaust = pairs ? share(duty[2 * i + 1], 80 - p->offset, 230 - p->offset)
                               : share(duty[i], 100 + p->offset, 0);
        if (p->faults[i] == HELD_FAULT) continue;
        if (p->faults[i] == OPEN_FAULT) fill = 1;
        p->fill[i] += (fill - p->fill[i]) * dt / p->valve_lag;
        p->exhaust[i] += (exhaust - p->exhaust[i]) * dt / p->valve_lag;
    }
}

void pneumatics_step(struct pneumatics *p, double dt, const double duty[MOST], bool dump_held_shut) {
    move_valves(p, dt, duty);
    double into_line = dump_held_shut ? flow(p->source_flow, p->source, p->line)
                                      : flow(p->source_flow, ATMOSPHERE, p->line);
    for (int i = 0; i < p->channels; i++) {
        double filling = flow(p->valve_flow * p->fill[i], p->line, p->node[i]);
        if (p->node[i] > p->line + p->cracking) // the check valve beside the filling valve
            filling -= flow(p->valve_flow, p->node[i], p->line + p->cracking);
        double through = flow(p->tube_flow, p->node[i], p->chamber[i]);
        double out = flow(p->valve_flow * p->exhaust[i], p->node[i], ATMOSPHERE);
        into_line -= filling;
        p->node[i] += (filling - out - through) * NORMAL / p->dead_volume * dt;
        double lost = flow(p->leak[i], p->chamber[i], ATMOSPHERE);
        p->chamber[i] += (through - lost) * NORMAL / p->volume[i] * dt;
    }
    p->line += into_line * NORMAL / p->line_volume * dt;
}

double pneumatics_voltage(const struct pneumatics *p, int channel) {
    if (channel == p->channels) return 0.5 + 4.0 * (p->line - ATMOSPHERE) / 5.0;
    return 0.5 + 4.0 * (p->node[channel] - ATMOSPHERE) / 2.5;
}
