// ATmega328P at 16 MHz. Pins: docs/open-regulator.md.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <string.h>

#include "port.h"

#ifndef BAUD_DIVISOR
#define BAUD_DIVISOR 1 // 500000 Bd, exactly; 8 makes 111111, near enough to 115200
#endif
#define SCAN (2 * (CHANNELS + 1)) // conversions of a tick
#define SUPPLY_INPUT 6
#define LINE 128 // bytes of a buffer, a power of 2

static uint8_t reset_flags __attribute__((section(".noinit")));
static volatile uint8_t milliseconds;
static volatile uint16_t sums[CHANNELS + 1];
static volatile uint8_t converted = 0;
static volatile uint8_t in[LINE], in_head, in_tail, out[LINE], out_head, out_tail;

// Before anything else: after a watchdog reset it is still running, with its shortest time.
void early(void) __attribute__((naked, used, section(".init3")));
void early(void) {
    reset_flags = MCUSR;
    MCUSR = 0;
    wdt_enable(WDTO_30MS);
}

static uint8_t input_of(uint8_t place) { return place == CHANNELS ? SUPPLY_INPUT : place; }

static void convert(uint8_t place) {
    ADMUX = _BV(REFS0) | input_of(place); // against the supply voltage, as the sensors are
    ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0); // 104 us
}

ISR(ADC_vect) {
    uint8_t place = converted % (CHANNELS + 1);
    sums[place] = converted <= CHANNELS ? ADC : sums[place] + ADC;
    if (++converted < SCAN) convert(converted % (CHANNELS + 1));
}

ISR(TIMER1_OVF_vect) { milliseconds++; }

ISR(USART_RX_vect) {
    uint8_t byte = UDR0, next = (in_head + 1) % LINE;
    if (next != in_tail) { // else it is lost, and the frame's CRC wrong
        in[in_head] = byte;
        in_head = next;
    }
}

ISR(USART_UDRE_vect) {
    if (out_tail == out_head) UCSR0B &= ~_BV(UDRIE0);
    else {
        UDR0 = out[out_tail];
        out_tail = (out_tail + 1) % LINE;
    }
}

uint8_t port_start(void) {
    PORTB = PORTC = PORTD = 0;
    DDRB = _BV(0) | _BV(1) | _BV(2) | _BV(3); // dump valve; OC1A, OC1B, OC2A
    DDRD = _BV(3) | _BV(5) | _BV(6);          // OC2B, OC0B, OC0A
    TCCR0A = TCCR2A = _BV(WGM01) | _BV(WGM00);
    TCCR0B = _BV(CS01) | _BV(CS00); // 977 Hz
    TCCR2B = _BV(CS22);
    ICR1 = 249; // 1 kHz, which is the clock too
    TCCR1A = _BV(WGM11);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS11) | _BV(CS10);
    TIMSK1 = _BV(TOIE1);
    UBRR0 = BAUD_DIVISOR;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00); // 8N1
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    convert(0);
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
    if (reset_flags & _BV(WDRF)) return WATCHDOG;
    if (reset_flags & _BV(PORF)) return POWER_ON; // the brown-out flag may be set then, too
    return reset_flags & _BV(BORF) ? BROWN_OUT : EXTERNAL_RESET;
}

bool port_tick(uint16_t counts[CHANNELS + 1]) {
    cli();
    if (milliseconds < TICK_MS && in_head == in_tail) {
        sleep_enable();
        sei(); // takes effect after the next instruction: no interrupt is missed
        sleep_cpu();
        sleep_disable();
    }
    sei();
    if (milliseconds < TICK_MS || converted < SCAN) return false; // no readings, no watchdog
    cli();
    milliseconds -= TICK_MS;
    sei();
    for (uint8_t i = 0; i <= CHANNELS; i++) counts[i] = sums[i];
    converted = 0;
    convert(0);
    return true;
}

uint16_t port_alive(void) {
    cli();
    uint16_t steps = TCNT1;
    uint8_t late = milliseconds;
    sei();
    wdt_reset();
    return late * 1000u + steps * 4u;
}

// Connect a pin to its timer, or switch it on or off: the timer cannot say never, nor always.
static void drive(volatile uint8_t *control, uint8_t connect, volatile uint8_t *port, uint8_t pin,
                  uint8_t duty) {
    uint8_t now = *control, next = duty && duty < 255 ? now | connect : now & ~connect;
    if (duty) *port |= pin;
    else *port &= ~pin;
    if (next != now) *control = next;
}

void port_drive(const uint8_t duty[OUTPUTS], bool hold_dump_shut) {
    OCR0A = duty[0];
    OCR0B = duty[1];
    cli();
    OCR1A = duty[2] - duty[2] / 51; // of 250
    OCR1B = duty[3] - duty[3] / 51;
    sei();
    OCR2A = duty[4];
    OCR2B = duty[5];
    drive(&TCCR0A, _BV(COM0A1), &PORTD, _BV(6), duty[0]);
    drive(&TCCR0A, _BV(COM0B1), &PORTD, _BV(5), duty[1]);
    drive(&TCCR1A, _BV(COM1A1), &PORTB, _BV(1), duty[2]);
    drive(&TCCR1A, _BV(COM1B1), &PORTB, _BV(2), duty[3]);
    drive(&TCCR2A, _BV(COM2A1), &PORTB, _BV(3), duty[4]);
    drive(&TCCR2A, _BV(COM2B1), &PORTD, _BV(3), duty[5]);
    if (hold_dump_shut) PORTB |= _BV(0);
    else PORTB &= ~_BV(0);
}

bool port_receive(uint8_t *byte) {
    if (in_tail == in_head) return false;
    *byte = in[in_tail];
    in_tail = (in_tail + 1) % LINE;
    return true;
}

void port_send(const uint8_t *bytes, uint8_t length) {
    while (length--) {
        uint8_t next = (out_head + 1) % LINE;
        if (next == out_tail) break; // the host sends faster than it reads: the frame is cut
        out[out_head] = *bytes++;
        out_head = next;
    }
    UCSR0B |= _BV(UDRIE0);
}
