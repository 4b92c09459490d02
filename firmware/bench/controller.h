/* The emulated ATmega328P with the bench at its pins.
 *
 * D9 (OC1A) pulse width, D8 ENABLE, D7 INTERLOCK, D13 lamp, D0 and D1 serial line, A0 position, A1 current, A2 third. */
#ifndef AMB_BENCH_CONTROLLER_H
#define AMB_BENCH_CONTROLLER_H

#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <stdio.h>

#include "line.h"
#include "plant.h"
#include "pwm.h"

struct controller {
    avr_t *avr;
    avr_uart_t *uart;
    struct plant *plant;
    struct line *line;
    FILE *trajectory;
    struct pwm pwm;
    uint64_t at;                      /* tick up to which the plant was carried */
    double volt_ticks;                /* since the last conversion of A0 */
    uint64_t volt_from;
    int enabled, lamp, interlock_open, xoff, feeding, odd_mode;
    int away;                         /* from the stops, since the last touch */
    double override[PLANT_SENSORS];   /* V at the pin, NaN: none */
    uint64_t first_enable;            /* tick, UINT64_MAX: not yet */
    uint64_t conversions, resets, late; /* late: received bytes that a real receiver would have lost */
    int awake;                 /* until now: the processor has not gone to sleep */
    uint16_t top;              /* ICR1 as far as it could be written */
    unsigned converted;        /* input of the conversion under way */
    uint64_t current_held[2]; /* ticks at which A1 was held: the last but one time, and the last */
};

/* Returns 0, or -1 after one line on standard error. */
int controller_begin(struct controller *c, const char *firmware, struct plant *plant, struct line *line);

/* Run on for some instructions. Returns the emulator's state. */
int controller_run(struct controller *c);

void controller_carry(struct controller *c);      /* the plant up to now */
void controller_wire(struct controller *c);       /* the levels of INTERLOCK and of the receive line */
void controller_break(struct controller *c);      /* the receive line falls: one byte without stop bit */
double controller_seconds(const struct controller *c);

/* uart.c */
int uart_begin(struct controller *c);
void uart_feed(struct controller *c);             /* see that waiting bytes go to the controller */

#endif
