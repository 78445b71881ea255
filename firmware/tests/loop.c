// The firmware's logic and the pneumatics in one loop, for tests on the host.
#include <stdlib.h>

#include "../simulator/pneumatics.h"
#include "../src/protocol.h"

#define STEPS 20 // of 0.1 ms in a tick

struct loop {
    struct regulator regulator;
    struct protocol protocol;
    struct pneumatics air;
    uint16_t counts[CHANNELS + 1]; // sums of two conversions
    double duty[MOST];
    int forced[CHANNELS + 1]; // counts that a sensor shows instead; 0: what is true
    uint64_t random;
    double noise; // counts, peak
};

size_t loop_size(void) { return sizeof(struct loop); }
int loop_channels(void) { return CHANNELS; }

void loop_init(struct loop *l, double supply, double volume, double noise, uint64_t seed) {
    regulator_init(&l->regulator, POWER_ON);
    protocol_init(&l->protocol, &l->regulator, POWER_ON);
    pneumatics_init(&l->air, CHANNELS, supply, volume);
    l->random = seed * 2 + 1;
    l->noise = noise;
    for (int i = 0; i <= CHANNELS; i++) l->counts[i] = l->forced[i] = 0;
    for (int i = 0; i < MOST; i++) l->duty[i] = 0;
}

struct pneumatics *loop_air(struct loop *l) { return &l->air; }
struct regulator *loop_regulator(struct loop *l) { return &l->regulator; }
void loop_force(struct loop *l, int sensor, int counts) { l->forced[sensor] = counts; }

static double noise_of(struct loop *l) { // -1 to 1
    l->random = l->random * 6364136223846793005u + 1442695040888963407u;
    return (double)(l->random >> 40) / (1 << 23) - 1;
}

static uint16_t convert(struct loop *l, int place) {
    if (l->forced[place]) return (uint16_t)l->forced[place];
    double counts = pneumatics_voltage(&l->air, place) / 5 * 1024 + l->noise * noise_of(l);
    return counts < 0 ? 0 : counts > 1023 ? 1023 : (uint16_t)counts;
}

// Let ticks pass; `trace` has the chambers' pressures (bar, gauge) and the openings of each tick.
void loop_run(struct loop *l, int ticks, double trace[][2 * CHANNELS]) {
    for (int tick = 0; tick < ticks; tick++) {
        uint16_t sums[CHANNELS + 1] = {0};
        for (int step = 0; step < STEPS; step++) {
            pneumatics_step(&l->air, 1e-4, l->duty, l->regulator.armed);
            if (step < 2 * (CHANNELS + 1))
                sums[step % (CHANNELS + 1)] += convert(l, step % (CHANNELS + 1));
        }
        regulator_tick(&l->regulator, sums);
        uint8_t duty[OUTPUTS];
        regulator_outputs(&l->regulator, duty);
        for (int i = 0; i < OUTPUTS; i++) l->duty[i] = duty[i] / 255.0;
        for (int i = 0; trace && i < CHANNELS; i++) {
            trace[tick][i] = l->air.chamber[i] - 1.0132;
            trace[tick][CHANNELS + i] = l->regulator.channels[i].opening / 1024.0;
        }
    }
}

int loop_receive(struct loop *l, const uint8_t *bytes, int count, uint8_t *replies) {
    int length = 0;
    for (int i = 0; i < count; i++)
        length += protocol_receive(&l->protocol, bytes[i], replies + length);
    return length;
}
