// Random bytes, spoilt frames and wild readings for the firmware's logic, under sanitizers.
//
//   fuzz SEED ROUNDS
//
// After each byte and each tick, what must always hold is checked.
#include <assert.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../src/protocol.h"

static struct regulator regulator;
static struct protocol protocol;
static uint64_t state;
static long armed_ticks, answers, pressed;

static uint32_t draw(uint32_t below) {
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (uint32_t)(state >> 33) % below;
}

static void check(void) {
    uint8_t duty[OUTPUTS];
    regulator_outputs(&regulator, duty);
    assert(regulator.slew >= 1 && regulator.slew <= MAX_SLEW);
    assert(regulator.remaining <= SILENCE_MS);
    for (int i = 0; i < CHANNELS; i++) {
        const struct channel *c = &regulator.channels[i];
        assert(c->limit >= 0 && c->limit <= MAX_PRESSURE);
        assert(c->set_point >= 0 && c->set_point <= c->limit);
        assert(c->ramp >= 0 && c->ramp <= c->limit * 64L);
        assert(c->opening >= -1024 && c->opening <= 1024);
        if (!regulator.armed) assert(!c->set_point && !c->opening);
        uint8_t fill = PAIRS ? duty[2 * i] : duty[i];
        if (!regulator.armed) assert(fill == (PAIRS ? 0 : EXHAUST_FULL));
        if (!regulator.armed && PAIRS) assert(duty[2 * i + 1] == EXHAUST_FULL);
        assert(fill <= FILL_FULL);
    }
}

static void send(const uint8_t *bytes, int count) {
    for (int i = 0; i < count; i++) {
        uint8_t reply[LONGEST_FRAME];
        uint8_t length = protocol_receive(&protocol, bytes[i], reply);
        assert(length <= LONGEST_FRAME);
        if (length) {
            answers++;
            assert(!reply[length - 1] && !memchr(reply, 0, length - 1u));
        }
        check();
    }
}

// A frame as the page defines it, written anew.
static int frame(uint8_t *out, uint8_t kind, const uint8_t *payload, int count) {
    uint8_t body[256] = {PROTOCOL_VERSION, BOARD_NUMBER, (uint8_t)draw(256), kind};
    memcpy(body + 4, payload, (size_t)count);
    uint16_t crc = 0xFFFF;
    for (int i = 0; i < count + 4; i++) {
        crc ^= (uint16_t)(body[i] << 8);
        for (int bit = 0; bit < 8; bit++) crc = (uint16_t)(crc << 1 ^ (crc & 0x8000 ? 0x1021 : 0));
    }
    assert(crc == crc16(body, (uint8_t)(count + 4)));
    body[count + 4] = (uint8_t)crc;
    body[count + 5] = (uint8_t)(crc >> 8);
    int end = 1, at = 0;
    for (int i = 0; i < count + 6; i++) {
        if (body[i]) out[end++] = body[i];
        else out[at] = (uint8_t)(end - at), at = end++;
    }
    out[at] = (uint8_t)(end - at);
    out[end++] = 0;
    return end;
}

static void request(void) {
    uint8_t payload[40], bytes[64];
    uint8_t kind = draw(8) ? (uint8_t)(1 + draw(7)) : (uint8_t)draw(256);
    int count = kind == SET ? 6 + 2 * CHANNELS : kind == LIMITS ? 2 + 2 * CHANNELS : 0;
    for (int i = 0; i < 40; i++) payload[i] = (uint8_t)draw(256);
    if (kind == LIMITS && draw(4))
        for (int i = 0; i <= CHANNELS; i++)
            payload[2 * i + 1] = i ? (uint8_t)draw(78) : 0;
    if (kind == SET && draw(8)) {
        uint32_t basis = regulator.time - draw(120);
        for (int i = 0; i < 4; i++) payload[i] = (uint8_t)(basis >> 8 * i);
        payload[4] = (uint8_t)(1 + draw(SILENCE_MS));
        payload[5] = 0;
        for (int i = 0; i < CHANNELS; i++) payload[7 + 2 * i] = (uint8_t)draw(20);
    }
    if (!draw(16)) count = (int)draw(41);
    int length = frame(bytes, kind, payload, count);
    if (!draw(4)) bytes[draw((uint32_t)length)] ^= (uint8_t)(1 << draw(8)); // noise
    if (!draw(8)) memmove(bytes + 3, bytes + 4, (size_t)--length - 3);      // a lost byte
    send(bytes, length);
}

static void tick(void) {
    uint16_t counts[CHANNELS + 1];
    bool wild = !draw(200);
    for (int i = 0; i <= CHANNELS; i++) counts[i] = (uint16_t)(205 + draw(wild ? 1842 : 30));
    counts[CHANNELS] = (uint16_t)(wild ? draw(2047) : 1000);
    bool was_armed = regulator.armed;
    regulator_tick(&regulator, counts);
    armed_ticks += regulator.armed;
    for (int i = 0; i < CHANNELS; i++) pressed += regulator.channels[i].ramp > 0;
    for (int i = 0; i <= CHANNELS; i++)
        if (counts[i] < 2 * SENSOR_LOWEST || counts[i] > 2 * SENSOR_HIGHEST) assert(!regulator.armed);
    if (!was_armed) assert(!regulator.armed);
    check();
}

int main(int count, char **words) {
    if (count != 3) return 2;
    state = strtoull(words[1], NULL, 10);
    regulator_init(&regulator, POWER_ON);
    protocol_init(&protocol, &regulator, POWER_ON);
    for (long round = atol(words[2]); round; round--) {
        uint32_t what = draw(10);
        if (what < 4) request();
        else if (what < 9) tick();
        else {
            uint8_t bytes[300];
            int length = (int)draw(sizeof bytes);
            for (int i = 0; i < length; i++) bytes[i] = (uint8_t)draw(draw(2) ? 256 : 6);
            send(bytes, length);
        }
    }
    printf("%ld answers, %ld ticks armed, %ld with a set-point\n", answers, armed_ticks, pressed);
    return !(answers && armed_ticks && pressed);
}
