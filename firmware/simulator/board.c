// The firmware in simavr, at the pace of real time, with a pseudo-terminal for its serial line and
// pneumatics behind its pins.
//
//   board FIRMWARE.elf CHANNELS [SUPPLY_BAR VOLUME_ML]
//
// It prints the terminal's name, then every 5 ms a line: its own time in ms, the pressures of the
// chambers in Pa, and whether the dump valve is shut (1). On standard input it takes, one a line:
//   noise N | lose N      of 1000 bytes in both directions, spoil or lose N
//   cable 0|1             unplug the serial cable, or plug it in
//   power 0|1             switch the board and its valves off, or on
//   reset | brown-out     press the reset button; let the supply voltage dip
//   hang                  overwrite the instruction that runs with an endless loop, till a reset
//   lag S                 time constant of all valves
//   valve CHANNEL STATE   0: works, 1: stuck open, 2: stuck as it is
//   leak CHANNEL C        a hole with this conductance, dm3/(s bar)
//   sensor CHANNEL MV     what the sensor shows, in mV; -1: the truth, -2: 0.7 of it and 0.2 bar
// Channels count from 0; that after the last one is the supply line.
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <simavr/avr_adc.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "pneumatics.h"

#define CLOCK 16000000
#define SLICE (CLOCK / 10000) // cycles between two looks at pins and line: 0.1 ms
#define BYTES 5               // that the line carries in a slice, at 500 kBd
#define NOISE 4               // mV, of sensors and converter
#define REPORT 50             // slices
#define BEHIND 20000000       // ns; what is later than this is never caught up with

static avr_t *avr;
static struct pneumatics air;
static int out, terminal, noise, lose, powered = 1, plugged = 1, forced[MOST + 1];
static avr_irq_t *line_in, *inputs;
static uint8_t to_board[4096], to_host[4096];
static unsigned board_head, board_tail, host_length;
static uint32_t hung_at;
static uint16_t hung_word;
static void (*mcu_reset)(avr_t *);

static void die(const char *what) {
    perror(what);
    exit(1);
}

static void sleep_no_time(avr_t *avr, avr_cycle_count_t cycles) { (void)avr, (void)cycles; }

static int spoilt(uint8_t *byte) { // true: lost
    if (rand() % 1000 < noise) *byte ^= (uint8_t)(1 << rand() % 8);
    return rand() % 1000 < lose;
}

static void said(avr_irq_t *irq, uint32_t value, void *unused) {
    (void)irq, (void)unused;
    uint8_t byte = (uint8_t)value;
    if (plugged && !spoilt(&byte) && host_length < sizeof to_host) to_host[host_length++] = byte;
}

// Registers of the ATmega328P.
enum { DDRB_ = 0x24, PORTB_ = 0x25, DDRD_ = 0x2A, PORTD_ = 0x2B, TCCR0A_ = 0x44, OCR0A_ = 0x47,
       OCR0B_ = 0x48, TCCR1A_ = 0x80, OCR1A_ = 0x88, OCR1B_ = 0x8A, TCCR2A_ = 0xB0, OCR2A_ = 0xB3,
       OCR2B_ = 0xB4, ICR1_ = 0x86 };

static const struct output {
    uint16_t ddr, port, control, compare;
    uint8_t pin, connect, wide;
} outputs[MOST] = {
    {DDRD_, PORTD_, TCCR0A_, OCR0A_, 6, 0x80, 0}, {DDRD_, PORTD_, TCCR0A_, OCR0B_, 5, 0x20, 0},
    {DDRB_, PORTB_, TCCR1A_, OCR1A_, 1, 0x80, 1}, {DDRB_, PORTB_, TCCR1A_, OCR1B_, 2, 0x20, 1},
    {DDRB_, PORTB_, TCCR2A_, OCR2A_, 3, 0x80, 0}, {DDRD_, PORTD_, TCCR2A_, OCR2B_, 3, 0x20, 0},
};

static double duty_of(const struct output *o) {
    const uint8_t *r = avr->data;
    if (!powered || !(r[o->ddr] >> o->pin & 1)) return 0; // the drivers have pull-down resistors
    if (!(r[o->control] & o->connect)) return r[o->port] >> o->pin & 1;
    if (!o->wide) return r[o->compare] / 255.0;
    unsigned top = r[ICR1_] | r[ICR1_ + 1] << 8;
    return (r[o->compare] | r[o->compare + 1] << 8) / (top + 1.0);
}

static int dump_shut(void) {
    return powered && (avr->data[DDRB_] & 1) && (avr->data[PORTB_] & 1);
}

static void blow(void) {
    double duty[MOST];
    for (int i = 0; i < MOST; i++) duty[i] = duty_of(&outputs[i]);
    pneumatics_step(&air, 1e-4, duty, dump_shut());
    for (int i = 0; i <= air.channels; i++) {
        double volts = pneumatics_voltage(&air, i);
        if (forced[i] == -2) volts = 0.5 + 0.7 * (volts - 0.5) + 0.2 * 4 / 2.5;
        int noise = rand() % (2 * NOISE + 1) - NOISE;
        int mv = forced[i] < 0 ? (int)(1000 * volts + 0.5) + noise : forced[i];
        avr_raise_irq(inputs + ADC_IRQ_ADC0 + (i == air.channels ? 6 : i), (uint32_t)mv);
    }
}

static void reset_too(avr_t *avr) { // at each reset, also that of the watchdog
    if (hung_at) memcpy(avr->flash + hung_at, &hung_word, 2);
    hung_at = 0;
    mcu_reset(avr);
}

static void restart(uint8_t why) {
    avr_reset(avr);
    avr->data[0x54] = why; // MCUSR
}

static void obey(const char *text) {
    char word[16] = "";
    int at = 0;
    double value = 0;
    int n = sscanf(text, "%15s %d %lf", word, &at, &value);
    if (!strcmp(word, "noise") && n == 2) noise = at;
    else if (!strcmp(word, "lose") && n == 2) lose = at;
    else if (!strcmp(word, "cable") && n == 2) plugged = at;
    else if (!strcmp(word, "lag")) air.valve_lag = atof(text + 4);
    else if (!strcmp(word, "power") && n == 2) {
        if (at && !powered) restart(1);
        powered = at;
    } else if (!strcmp(word, "reset")) restart(2);
    else if (!strcmp(word, "brown-out")) restart(4);
    else if (!strcmp(word, "hang") && !hung_at) {
        hung_at = avr->pc;
        memcpy(&hung_word, avr->flash + hung_at, 2);
        memcpy(avr->flash + hung_at, "\xff\xcf", 2); // rjmp to itself
    } else if (n == 3 && at >= 0 && at <= air.channels) {
        if (!strcmp(word, "sensor")) forced[at] = (int)value;
        else if (!strcmp(word, "valve") && at < air.channels) air.faults[at] = (uint8_t)value;
        else if (!strcmp(word, "leak") && at < air.channels) air.leak[at] = value;
    }
}

static void listen(void) { // to the commands, and end with the program that gives them
    static char text[256];
    static size_t length;
    struct pollfd in = {0, POLLIN, 0};
    while (poll(&in, 1, 0) > 0) {
        ssize_t got = read(0, text + length, sizeof text - 1 - length);
        if (got <= 0) exit(0);
        text[length += (size_t)got] = 0;
        char *end;
        while ((end = strchr(text, '\n'))) {
            *end = 0;
            obey(text);
            length -= (size_t)(end + 1 - text);
            memmove(text, end + 1, length + 1);
        }
        if (length == sizeof text - 1) length = 0;
    }
}

static void carry(void) { // bytes between the terminal and the pins
    uint8_t bytes[256];
    ssize_t got = read(terminal, bytes, sizeof bytes);
    for (ssize_t i = 0; i < got; i++)
        if (plugged && powered && !spoilt(&bytes[i])) {
            unsigned next = (board_head + 1) % sizeof to_board;
            if (next == board_tail) break;
            to_board[board_head] = bytes[i];
            board_head = next;
        }
    for (int i = 0; i < BYTES && board_tail != board_head; i++) {
        avr_raise_irq(line_in, to_board[board_tail]);
        board_tail = (board_tail + 1) % sizeof to_board;
    }
    if (host_length && powered && write(terminal, to_host, host_length) < 0) { /* nobody reads */ }
    host_length = 0;
}

static void report(void) {
    char text[256];
    int n = snprintf(text, sizeof text, "%llu ", (unsigned long long)(avr->cycle / (CLOCK / 1000)));
    for (int i = 0; i < air.channels; i++)
        n += snprintf(text + n, sizeof text - (size_t)n, "%.1f ", (air.chamber[i] - 1.0132) * 1e5);
    n += snprintf(text + n, sizeof text - (size_t)n, "%d\n", dump_shut());
    if (write(out, text, (size_t)n) != n) exit(0);
}

static int64_t now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void keep_pace(int64_t *due) {
    int64_t ahead = *due - now();
    if (ahead < -BEHIND) *due -= ahead; // a burst would look to the firmware like silence
    if (ahead > 1000000) {
        struct timespec pause = {0, ahead};
        nanosleep(&pause, NULL);
    }
}

static void open_terminal(void) {
    struct termios raw;
    terminal = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (terminal < 0 || grantpt(terminal) || unlockpt(terminal)) die("no pseudo-terminal");
    int other = open(ptsname(terminal), O_RDWR | O_NOCTTY); // held, or the line would hang up
    if (other < 0 || tcgetattr(other, &raw)) die("no pseudo-terminal");
    cfmakeraw(&raw);
    tcsetattr(other, TCSANOW, &raw);
    dprintf(out, "%s\n", ptsname(terminal));
}

static void start(const char *path) {
    elf_firmware_t firmware = {0};
    if (elf_read_firmware(path, &firmware)) exit(1);
    avr = avr_make_mcu_by_name("atmega328p");
    if (!avr) exit(1);
    avr->log = LOG_NONE;
    avr_init(avr);
    firmware.frequency = CLOCK;
    avr_load_firmware(avr, &firmware);
    avr->log = LOG_NONE;
    avr->sleep = sleep_no_time;
    mcu_reset = avr->reset;
    avr->reset = reset_too;
    avr->avcc = avr->aref = avr->vcc = 5000;
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags); // neither prints nor sleeps
    line_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), said, 0);
    inputs = avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, 0);
    avr->data[0x54] = 1; // switched on
}

int main(int count, char **words) {
    if (count < 3) return 2;
    out = dup(1); // simavr writes to the other one
    dup2(2, 1);
    start(words[1]);
    pneumatics_init(&air, atoi(words[2]), count > 3 ? atof(words[3]) : 2.5,
                    (count > 4 ? atof(words[4]) : 20) / 1000);
    for (int i = 0; i <= MOST; i++) forced[i] = -1;
    open_terminal();
    int64_t due = now();
    avr_cycle_count_t goal = avr->cycle;
    for (int slice = 1;; slice++) {
        carry();
        blow();
        goal += SLICE;
        while (powered && avr->cycle < goal) {
            int state = avr_run(avr);
            if (state == cpu_Done || state == cpu_Crashed) return 1;
        }
        if (!powered) avr->cycle = goal;
        if (slice % 10 == 0) {
            listen();
            due += 10 * 100000;
            keep_pace(&due);
        }
        if (slice % REPORT == 0) report();
    }
}
