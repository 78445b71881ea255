// One channel: slew limit, pressure control, and what is wrong with its readings.
#ifndef CHANNEL_H
#define CHANNEL_H

#include <stdbool.h>
#include <stdint.h>

#define TICK_MS 2

enum cause { // why the board is vented
    POWER_ON = 1, EXTERNAL_RESET, BROWN_OUT, WATCHDOG, ASKED, SILENCE,
    BAD_SENSOR, ABOVE_LIMIT, NOT_FOLLOWING, STUCK_SENSOR
};

struct channel {
    int16_t limit;     // highest set-point and pressure
    int16_t set_point; // what the host asked for
    int16_t reading;
    int16_t opening;   // of the valves: 1024 fills fully, -1024 exhausts fully
    int32_t ramp;      // set-point within the slew limit; this and all below in 1/64 of a unit
    int32_t first, second; // the ramp, smoothed as quickly as valves and sensors follow it
    int32_t integral;  // rate per tick that holds the pressure against a leak
    int32_t given, seen; // change of pressure in the last 130 ms, by the valves and by the sensor
    int16_t astray;    // ticks for which the pressure is not where it should be
};

// Forget all that has been commanded.
void channel_reset(struct channel *c);

// Take a new reading; returns the cause to vent, or 0. `sensible` is false if the sensor is broken.
uint8_t channel_check(struct channel *c, int16_t reading, bool sensible);

// Move the valves; `slew` in units per ms, `supply` is the gauge pressure in front of the valves.
void channel_control(struct channel *c, uint16_t slew, int16_t supply);

// What flows through a fully open orifice, as the pressure in front of it that would choke it:
// ISO 6358 with a critical ratio of 0.5; absolute pressures.
uint16_t flow_capacity(uint16_t before, uint16_t behind);

#endif
