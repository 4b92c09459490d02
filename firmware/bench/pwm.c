/* See the data sheet of the ATmega328P, sections 16.9.3 and 16.11.1. */
#include "pwm.h"

#define IDLE_PERIOD 800u /* of the noise, while the timer stands */

uint32_t pwm_period(const struct pwm *p) { return p->running ? p->top + 1 : IDLE_PERIOD; }

uint32_t pwm_width(const struct pwm *p)
{
    const uint32_t period = pwm_period(p);
    if (!p->output)
        return 0; /* a pull-down holds the driver's input */
    if (p->connected < 2)
        return p->level ? period : 0;
    if (!p->running)
        return 0;
    const uint32_t before = p->compare >= p->top ? period : p->compare + 1;
    return p->connected == 2 ? before : period - before;
}

int pwm_level(const struct pwm *p, uint64_t tick, uint64_t *until, int *bottom)
{
    const uint32_t period = pwm_period(p), width = pwm_width(p);
    const uint32_t phase = (uint32_t)((tick - p->base) % period);
    const int first = p->connected != 3; /* level at the bottom, where there is an edge */
    const uint32_t edge = first ? width : period - width;
    const int before = phase < edge;
    *bottom = !before || edge == period;
    *until = tick + (before ? edge : period) - phase;
    return before ? first : !first;
}
