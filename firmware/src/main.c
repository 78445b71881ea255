#include "port.h"
#include "protocol.h"

static struct regulator regulator;
static struct protocol protocol;

static void act(void) {
    uint8_t duty[OUTPUTS];
    regulator_outputs(&regulator, duty);
    port_drive(duty, regulator.armed);
}

int main(void) {
    uint8_t cause = port_start();
    uint16_t counts[CHANNELS + 1];
    uint8_t byte, reply[LONGEST_FRAME];
    regulator_init(&regulator, cause);
    protocol_init(&protocol, &regulator, cause);
    for (;;) {
        if (port_tick(counts)) {
            regulator_tick(&regulator, counts);
            act();
            uint16_t us = port_alive(); // the watchdog is fed here alone
            if (us > protocol.longest_us) protocol.longest_us = us;
        }
        if (port_receive(&byte)) {
            uint8_t length = protocol_receive(&protocol, byte, reply);
            if (length) {
                act(); // a vent does not wait for the tick
                port_send(reply, length);
            }
        }
    }
}
