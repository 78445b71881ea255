#include "protocol.h"

#include <string.h>

#define HEADER 4 // version, board, sequence, kind
#define CRC 2

uint16_t crc16(const uint8_t *bytes, uint8_t length) { // CRC-16/CCITT-FALSE
    uint16_t crc = 0xFFFF;
    while (length--) {
        crc = (uint16_t)(crc >> 8 | crc << 8) ^ *bytes++;
        crc ^= (crc & 0xFF) >> 4;
        crc ^= (uint16_t)(crc << 12);
        crc ^= (crc & 0xFF) << 5;
    }
    return crc;
}

// Consistent overhead byte stuffing: a frame without zeros, then one zero.
static uint8_t stuff(const uint8_t *body, uint8_t length, uint8_t *frame) {
    uint8_t code_at = 0, end = 1;
    for (uint8_t i = 0; i < length; i++) {
        if (body[i]) frame[end++] = body[i];
        else {
            frame[code_at] = end - code_at;
            code_at = end++;
        }
    }
    frame[code_at] = end - code_at;
    frame[end++] = 0;
    return end;
}

// In place; returns the length of the body, or 0 if it is none.
static uint8_t unstuff(uint8_t *frame, uint8_t length) {
    uint8_t to = 0, from = 0;
    while (from < length) {
        uint8_t end = frame[from++];
        if (end > length - from + 1) return 0;
        while (--end) frame[to++] = frame[from++];
        if (from < length) frame[to++] = 0;
    }
    return to;
}

static uint16_t u16(const uint8_t *at) { return (uint16_t)(at[0] | (uint16_t)at[1] << 8); }

static uint32_t u32(const uint8_t *at) { return u16(at) | (uint32_t)u16(at + 2) << 16; }

static uint8_t *put16(uint8_t *at, uint16_t value) {
    *at++ = value & 0xFF;
    *at++ = value >> 8;
    return at;
}

static uint8_t *put32(uint8_t *at, uint32_t value) {
    return put16(put16(at, value & 0xFFFF), value >> 16);
}

static uint8_t *put_identity(uint8_t *at) {
    *at++ = PROTOCOL_VERSION; // this payload stays as it is in all versions
    *at++ = FIRMWARE_MAJOR;
    *at++ = FIRMWARE_MINOR;
    *at++ = CHANNELS;
    at = put16(at, SILENCE_MS);
    at = put16(at, MAX_PRESSURE);
    return put16(at, MAX_SLEW);
}

static uint8_t *put_state(const struct regulator *r, uint8_t *at) {
    *at++ = r->armed;
    *at++ = r->cause;
    *at++ = r->at;
    return at;
}

static uint8_t *put_status(const struct regulator *r, uint8_t *at) {
    at = put_state(r, put32(at, r->time));
    at = put16(at, (uint16_t)r->supply);
    for (uint8_t i = 0; i < CHANNELS; i++) {
        at = put16(at, (uint16_t)r->channels[i].set_point);
        at = put16(at, (uint16_t)r->channels[i].reading);
    }
    return at;
}

static uint8_t *put_limits(const struct regulator *r, uint8_t *at) {
    at = put16(at, r->slew);
    for (uint8_t i = 0; i < CHANNELS; i++) at = put16(at, (uint16_t)r->channels[i].limit);
    return at;
}

static uint8_t *put_statistics(const struct protocol *p, uint8_t *at) {
    *at++ = p->reset_cause;
    at = put32(at, p->regulator->time);
    at = put16(at, p->good);
    at = put16(at, p->bad);
    at = put16(at, p->refused);
    at = put16(at, p->regulator->trips);
    return put16(at, p->longest_us);
}

static void read_pressures(const uint8_t *at, int16_t pressures[CHANNELS]) {
    for (uint8_t i = 0; i < CHANNELS; i++) pressures[i] = (int16_t)u16(at + 2 * i);
}

static uint8_t limit(struct regulator *r, const uint8_t *payload) {
    int16_t limits[CHANNELS];
    read_pressures(payload + 2, limits);
    if (r->armed) return IS_ARMED;
    return regulator_limit(r, limits, u16(payload)) ? 0 : BAD_RANGE;
}

static uint8_t set(struct regulator *r, const uint8_t *payload) {
    int16_t pressures[CHANNELS];
    uint32_t age = r->time - u32(payload); // of what the host knew
    uint16_t validity = u16(payload + 4);
    bool nothing = true;
    read_pressures(payload + 6, pressures);
    for (uint8_t i = 0; i < CHANNELS; i++) nothing = nothing && !pressures[i];
    if (validity < 1 || validity > SILENCE_MS) return BAD_RANGE;
    if (!r->armed) return nothing ? 0 : IS_VENTED; // to ask for nothing is always allowed
    if (age >= validity) return EXPIRED;
    return regulator_set(r, pressures, (uint16_t)(validity - age)) ? 0 : BAD_RANGE;
}

static uint8_t payload_length(uint8_t kind) {
    return kind == LIMITS ? 2 + 2 * CHANNELS : kind == SET ? 6 + 2 * CHANNELS : 0;
}

static uint8_t carry_out(struct regulator *r, uint8_t kind, const uint8_t *payload) {
    switch (kind) {
    case LIMITS: return limit(r, payload);
    case SET: return set(r, payload);
    case ARM: return regulator_arm(r) ? 0 : IS_FAULTY;
    case VENT: regulator_vent(r, ASKED, 0); return 0;
    case IDENTITY: case READ: case STATISTICS: return 0;
    default: return BAD_KIND;
    }
}

// Answer a body whose CRC is right, in place; returns the length of the reply without its CRC.
static uint8_t answer(struct protocol *p, uint8_t *body, uint8_t length) {
    struct regulator *r = p->regulator;
    uint8_t kind = body[3], error, *at = body + HEADER;
    bool for_any = !body[1] && (kind == IDENTITY || kind == VENT);
    if (body[1] != BOARD_NUMBER && !for_any) return 0; // for another board
    if (body[0] != PROTOCOL_VERSION && kind != IDENTITY) error = BAD_VERSION;
    else if (length != HEADER + payload_length(kind)) error = BAD_LENGTH;
    else error = carry_out(r, kind, at);
    body[0] = PROTOCOL_VERSION;
    body[1] = BOARD_NUMBER;
    body[3] = error ? ERROR_REPLY : kind | REPLY;
    if (error) {
        p->refused++;
        *at++ = error;
        at = put_state(r, at);
        *at++ = r->fault;
        *at++ = r->fault_at;
    } else if (kind == IDENTITY) at = put_identity(at);
    else if (kind == LIMITS) at = put_limits(r, at);
    else if (kind == STATISTICS) at = put_statistics(p, at);
    else at = put_status(r, at);
    return (uint8_t)(at - body);
}

static uint8_t close_frame(struct protocol *p, uint8_t reply[LONGEST_FRAME]) {
    uint8_t body[LONGEST_BODY];
    uint8_t length = p->too_long ? 0 : unstuff(p->buffer, p->length);
    bool empty = !p->length && !p->too_long;
    p->length = 0;
    p->too_long = false;
    if (empty) return 0; // zeros between frames are welcome
    if (length < HEADER + CRC || u16(p->buffer + length - CRC) != crc16(p->buffer, length - CRC)) {
        p->bad++; // from whom, and what for, is not known: no answer
        return 0;
    }
    p->good++;
    memcpy(body, p->buffer, length);
    length = answer(p, body, length - CRC);
    if (!length) return 0;
    put16(body + length, crc16(body, length));
    return stuff(body, length + CRC, reply);
}

void protocol_init(struct protocol *p, struct regulator *regulator, uint8_t reset_cause) {
    memset(p, 0, sizeof *p);
    p->regulator = regulator;
    p->reset_cause = reset_cause;
}

uint8_t protocol_receive(struct protocol *p, uint8_t byte, uint8_t reply[LONGEST_FRAME]) {
    if (!byte) return close_frame(p, reply);
    if (p->length < LONGEST_BODY + 1) p->buffer[p->length++] = byte;
    else p->too_long = true;
    return 0;
}
