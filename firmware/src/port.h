// What the firmware needs of a microcontroller. avr/ has it for the ATmega328P.
#ifndef PORT_H
#define PORT_H

#include "regulator.h"

// Start timer, converter and serial line, with all valves off; returns the cause of the reset.
uint8_t port_start(void);

// Sleep until there is something to do; true once every TICK_MS, with new sums of two conversions.
bool port_tick(uint16_t counts[CHANNELS + 1]);

// Tell the hardware watchdog that all is well, and return the us since the tick was due.
uint16_t port_alive(void);

void port_drive(const uint8_t duty[OUTPUTS], bool hold_dump_shut);

// The next byte from the line; false if there is none.
bool port_receive(uint8_t *byte);

void port_send(const uint8_t *bytes, uint8_t length);

#endif
