#include "channel.h"

#include "config.h"

#define ONE 64 // of a pressure
#define FULLY 1024 // open
#define VALVE_LAG 5  // ticks
#define SENSOR_LAG 3 // ticks, with that of the tube
#define PROPORTIONAL(error) ((error) * 9 / 64) // made good in 7 ticks
#define INTEGRAL(error) ((error) / 256)        // 36 ticks more slowly
#define MOST (512L * ONE) // rate per tick that is ever demanded
#define STEADY (100L * ONE) // what is left to go when the integral begins to act
#define MEMORY 32 // ticks
#define LEAST (18L * ONE) // rate per tick that a nearly balanced valve is taken for
#define PER_TICK ((int32_t)FLOW_RATE * TICK_MS * ONE * 256 / 1000) // of 256

static int32_t within(int32_t value, int32_t most) {
    return value > most ? most : value < -most ? -most : value;
}

// Within 1 %; the 8-bit processor needs a fifth of the time that all digits would take.
static uint16_t square_root(uint32_t value) {
    uint8_t root = 0, halvings = 0;
    for (; value > 0xFFFF; value /= 4) halvings++;
    for (uint8_t bit = 0x80; bit; bit >>= 1) {
        uint8_t trial = root | bit;
        if ((uint16_t)trial * trial <= (uint16_t)value) root = trial;
    }
    return (uint16_t)root << halvings;
}

// part / whole of FULLY, for rates; FULLY if it is more.
static int16_t share(int32_t part, int32_t whole) {
    if (part >= whole) return FULLY;
    uint16_t left = (uint16_t)(part / 2), by = (uint16_t)(whole / 2), quotient = 0;
    for (uint8_t digit = 0; digit < 10; digit++) {
        left *= 2;
        quotient *= 2;
        if (left >= by) {
            left -= by;
            quotient++;
        }
    }
    return (int16_t)quotient;
}

uint16_t flow_capacity(uint16_t before, uint16_t behind) {
    if (before <= behind) return 0;
    if (behind <= before / 2) return before;
    return 2 * square_root((uint32_t)behind * (uint16_t)(before - behind));
}

static uint16_t absolute(int16_t gauge) {
    return gauge < -ATMOSPHERE ? 0 : (uint16_t)(gauge + ATMOSPHERE);
}

void channel_reset(struct channel *c) {
    c->set_point = 0;
    c->opening = 0;
    c->ramp = c->first = c->second = 0;
    c->integral = 0;
    c->given = c->seen = 0;
    c->astray = 0;
}

uint8_t channel_check(struct channel *c, int16_t reading, bool sensible) {
    c->seen += (int32_t)(reading - c->reading) * ONE - c->seen / MEMORY;
    c->reading = reading;
    if (!sensible) return BAD_SENSOR;
    if (reading > c->limit + OVER_LIMIT) return ABOVE_LIMIT;
    if (c->given > (int32_t)STUCK_AIR * ONE && c->seen < c->given / 4) return STUCK_SENSOR;
    int32_t error = c->second - (int32_t)reading * ONE;
    bool near = within(error, (int32_t)FOLLOW_ERROR * ONE) == error;
    if (near && c->opening < FULLY) c->astray = 0;
    else if (c->astray >= FOLLOW_MS / TICK_MS) return NOT_FOLLOWING;
    else c->astray++;
    return 0;
}

void channel_control(struct channel *c, uint16_t slew, int16_t supply) {
    int16_t most = c->limit > HEADROOM ? c->limit - HEADROOM : 0;
    int32_t goal = (int32_t)(c->set_point < most ? c->set_point : most) * ONE;
    if (c->opening < FULLY || goal < c->ramp) // else it waits for the supply
        c->ramp += within(goal - c->ramp, (int32_t)slew * TICK_MS * ONE);
    int32_t forward = (c->ramp - c->first) / VALVE_LAG; // rate of `first`, per tick
    c->first += forward;
    c->second += (c->first - c->second) / SENSOR_LAG;
    // the valves act on `first`; the pressure follows as late as `second` does
    int32_t error = c->second - (int32_t)c->reading * ONE;
    int32_t demand = within(forward + PROPORTIONAL(error) + c->integral, MOST);

    uint16_t inside = absolute(c->reading);
    uint16_t capacity = demand > 0 ? flow_capacity(absolute(supply), inside)
                                   : flow_capacity(inside, ATMOSPHERE);
    int32_t full = (int32_t)capacity * PER_TICK / 256; // rate per tick, valve fully open
    if (full < LEAST) full = LEAST;
    int16_t opening = share(demand < 0 ? -demand : demand, full);
    c->opening = demand < 0 ? -opening : opening;
    bool steady = within(c->first - c->second, STEADY) == c->first - c->second;
    if (steady && opening < FULLY) c->integral = within(c->integral + INTEGRAL(error), MOST / 4);

    int32_t let_in = capacity && demand > 0 ? within(demand, full) : 0;
    c->given += let_in - c->given / MEMORY;
}
