// Valves, supply line and chambers, as the firmware does not know them: in bar, dm3 and s.
#ifndef PNEUMATICS_H
#define PNEUMATICS_H

#include <stdbool.h>
#include <stdint.h>

#define MOST 6 // channels, and outputs

enum valve_fault { NO_FAULT, OPEN_FAULT, HELD_FAULT };

struct pneumatics {
    int channels;      // 3: pairs of valves; 6: 3-way valves
    // what it is made of
    double source;     // absolute pressure of the supply
    double source_flow;// sonic conductance from the source to the line, dm3/(s bar)
    double line_volume;
    double valve_flow; // conductance of a fully open valve
    double valve_lag;  // s
    double offset;     // duty by which the valves open earlier than they should, of 255
    double tube_flow, dead_volume; // between valve and chamber; the sensor is at the valve
    double volume[MOST];
    double leak[MOST]; // conductance of a hole in the chamber
    double cracking;   // pressure that opens the check valve from a channel to the line
    uint8_t faults[MOST]; // of the valves of each channel
    // its state: absolute pressures, and how far the valves are open
    double line, node[MOST], chamber[MOST], fill[MOST], exhaust[MOST];
};

void pneumatics_init(struct pneumatics *p, int channels, double supply_gauge, double volume);

// Let some time pass, at most 0.2 ms; `duty` of 1 is always on.
void pneumatics_step(struct pneumatics *p, double dt, const double duty[MOST], bool dump_held_shut);

// What the sensors say, in V: the channels', or that of the line for `channel` == channels.
double pneumatics_voltage(const struct pneumatics *p, int channel);

#endif
