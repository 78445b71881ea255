#include "regulator.h"

#include <string.h>

static const uint16_t zero[] = SENSOR_ZERO, span[] = SENSOR_SPAN;

static int16_t pressure(uint16_t sum, uint16_t zero, uint16_t span) {
    // 16 times the counts; each conversion has lost half a count on average
    int32_t value = ((int32_t)(sum * 8 + 8) - zero) * span / 4096;
    return value > INT16_MAX ? INT16_MAX : (int16_t)value;
}

static bool sensible(uint16_t sum) {
    return sum >= 2 * SENSOR_LOWEST && sum <= 2 * SENSOR_HIGHEST;
}

void regulator_init(struct regulator *r, uint8_t cause) {
    memset(r, 0, sizeof *r);
    for (uint8_t i = 0; i < CHANNELS; i++) r->channels[i].limit = MAX_PRESSURE;
    r->slew = MAX_SLEW;
    r->cause = cause;
    r->fault = BAD_SENSOR; // until they were read
}

void regulator_vent(struct regulator *r, uint8_t cause, uint8_t at) {
    if (r->armed || cause == ASKED) {
        r->cause = cause;
        r->at = at;
    }
    if (r->armed && cause != ASKED) r->trips++;
    r->armed = false;
    for (uint8_t i = 0; i < CHANNELS; i++) channel_reset(&r->channels[i]);
}

bool regulator_arm(struct regulator *r) {
    if (r->fault) return false;
    for (uint8_t i = 0; i < CHANNELS; i++) channel_reset(&r->channels[i]);
    r->remaining = SILENCE_MS;
    r->armed = true;
    return true;
}

bool regulator_limit(struct regulator *r, const int16_t limits[CHANNELS], uint16_t slew) {
    if (r->armed || slew < 1 || slew > MAX_SLEW) return false;
    for (uint8_t i = 0; i < CHANNELS; i++)
        if (limits[i] < 0 || limits[i] > MAX_PRESSURE) return false;
    for (uint8_t i = 0; i < CHANNELS; i++) r->channels[i].limit = limits[i];
    r->slew = slew;
    return true;
}

bool regulator_set(struct regulator *r, const int16_t set_points[CHANNELS], uint16_t for_ms) {
    for (uint8_t i = 0; i < CHANNELS; i++)
        if (set_points[i] < 0 || set_points[i] > r->channels[i].limit) return false;
    for (uint8_t i = 0; i < CHANNELS; i++) r->channels[i].set_point = set_points[i];
    r->remaining = for_ms;
    return true;
}

static void check(struct regulator *r, const uint16_t counts[CHANNELS + 1]) {
    r->fault = r->fault_at = 0;
    for (uint8_t i = 0; i <= CHANNELS; i++) {
        bool good = sensible(counts[i]);
        uint8_t fault = good ? 0 : BAD_SENSOR;
        if (i == CHANNELS) r->supply = pressure(counts[i], SUPPLY_ZERO, SUPPLY_SPAN);
        else fault = channel_check(&r->channels[i], pressure(counts[i], zero[i], span[i]), good);
        if (fault && !r->fault) {
            r->fault = fault;
            r->fault_at = i + 1;
        }
    }
}

void regulator_tick(struct regulator *r, const uint16_t counts[CHANNELS + 1]) {
    r->time += TICK_MS;
    check(r, counts);
    if (!r->armed) return;
    r->remaining = r->remaining > TICK_MS ? r->remaining - TICK_MS : 0;
    if (r->fault) regulator_vent(r, r->fault, r->fault_at);
    else if (!r->remaining) regulator_vent(r, SILENCE, 0);
    else
        for (uint8_t i = 0; i < CHANNELS; i++)
            channel_control(&r->channels[i], r->slew, r->supply);
}

static uint8_t duty_between(uint8_t begins, uint8_t full, int16_t opening) {
    return (uint8_t)(begins + (int32_t)(full - begins) * opening / 1024);
}

void regulator_outputs(const struct regulator *r, uint8_t duty[OUTPUTS]) {
    for (uint8_t i = 0; i < CHANNELS; i++) {
        int16_t opening = r->armed ? r->channels[i].opening : -1024;
        uint8_t fill = opening > 0 ? duty_between(FILL_BEGINS, FILL_FULL, opening) : 0;
        uint8_t exhaust = duty_between(EXHAUST_BEGINS, EXHAUST_FULL, opening < 0 ? -opening : 0);
#if PAIRS
        duty[2 * i] = fill;
        duty[2 * i + 1] = opening < 0 ? exhaust : 0;
#else
        duty[i] = opening > 0 ? fill : exhaust;
#endif
    }
}
