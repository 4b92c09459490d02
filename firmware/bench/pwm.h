/* The output pin OC1A of Timer1 in fast pulse width modulation with ICR1 as top, as the ATmega328P makes it. */
#ifndef AMB_BENCH_PWM_H
#define AMB_BENCH_PWM_H

#include <stdint.h>

struct pwm {
    int running;              /* the clock is on, and the mode is 14 */
    int connected;            /* COM1A: 0 not, 2 low from the match on, 3 high from the match on */
    int output, level;        /* the pin's direction and port bit */
    uint32_t top;             /* ICR1: a period is one tick longer */
    uint32_t compare, next;   /* OCR1A that acts, and the one that acts from the next bottom on */
    uint64_t base;            /* tick of some bottom */
};

uint32_t pwm_period(const struct pwm *p);

/* Ticks of a period in which the pin is high: compare + 1, or all of it for compare >= top. */
uint32_t pwm_width(const struct pwm *p);

/* Level of the pin at `tick`; `until` is where that may change: an edge, or the bottom (`*bottom` is set). */
int pwm_level(const struct pwm *p, uint64_t tick, uint64_t *until, int *bottom);

#endif
