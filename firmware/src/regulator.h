// The board's decisions: when to take commands, when to vent, and what the valves do.
#ifndef REGULATOR_H
#define REGULATOR_H

#include "channel.h"
#include "config.h"

#define SUPPLY_CHANNEL (CHANNELS + 1) // as the channel of a cause: the supply line's sensor

struct regulator {
    struct channel channels[CHANNELS];
    int16_t supply;
    bool armed;
    uint8_t cause;      // why it is vented, or was last
    uint8_t at;         // channel that was the cause, from 1; 0: none
    uint8_t fault;      // what is wrong with a sensor now, and where; it cannot be armed
    uint8_t fault_at;
    uint16_t slew;      // units per ms
    uint16_t remaining; // ms for which the last command holds
    uint32_t time;      // ms since the start
    uint16_t trips;     // how often it vented by itself
};

// Begin vented; `cause` is that of the reset.
void regulator_init(struct regulator *r, uint8_t cause);

// Every TICK_MS: take readings, sums of two conversions (CHANNELS and the supply), and act.
void regulator_tick(struct regulator *r, const uint16_t counts[CHANNELS + 1]);

void regulator_vent(struct regulator *r, uint8_t cause, uint8_t at);

// Take commands from now on, with all set-points 0; false if a sensor is broken.
bool regulator_arm(struct regulator *r);

// Set limits, in units, and the slew, in units per ms; false if out of range or armed.
bool regulator_limit(struct regulator *r, const int16_t limits[CHANNELS], uint16_t slew);

// Take set-points for some ms; false, and nothing changes, if one is out of range.
bool regulator_set(struct regulator *r, const int16_t set_points[CHANNELS], uint16_t for_ms);

// Duty of each output, 255 for always on. The dump valve is held shut while the board is armed.
void regulator_outputs(const struct regulator *r, uint8_t duty[OUTPUTS]);

#endif
