// The serial protocol, version 1: frames, and what they ask for. docs/open-regulator.md defines it.
#ifndef PROTOCOL_H
#define PROTOCOL_H

#include "regulator.h"

#ifndef PROTOCOL_VERSION
#define PROTOCOL_VERSION 1
#endif
#define FIRMWARE_MAJOR 1
#define FIRMWARE_MINOR 0

#define LONGEST_BODY 60                 // header, payload and CRC
#define LONGEST_FRAME (LONGEST_BODY + 2) // as sent, with the zero at its end

enum request { IDENTITY = 1, LIMITS, ARM, SET, VENT, READ, STATISTICS };
enum { REPLY = 0x80, ERROR_REPLY = 0xFF };
enum error {
    BAD_VERSION = 1, BAD_KIND, BAD_LENGTH, BAD_RANGE, EXPIRED, IS_VENTED, IS_FAULTY, IS_ARMED
};

struct protocol {
    struct regulator *regulator;
    uint8_t buffer[LONGEST_FRAME];
    uint8_t length;
    bool too_long;
    uint8_t reset_cause;
    uint16_t good, bad, refused, longest_us; // frames, and the time of a tick
};

void protocol_init(struct protocol *p, struct regulator *regulator, uint8_t reset_cause);

// Take a byte from the line; returns the length of the frame to be sent, or 0.
uint8_t protocol_receive(struct protocol *p, uint8_t byte, uint8_t reply[LONGEST_FRAME]);

uint16_t crc16(const uint8_t *bytes, uint8_t length);

#endif
