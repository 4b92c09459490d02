/*
 * The position loop. Right shifts of negative numbers are arithmetic, as in every compiler for these machines. Shifts of
 * 32 bits are by 4 or 16 only: the processor shifts by one bit at a time, but moves whole bytes.
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* also where the Arduino IDE asks for small code: it runs in each tick */
#endif
#include "control.h"

#include <stddef.h>

#include "multiply.h"

#define DERIVATIVE_LARGEST (1L << 28)
#define INTEGRAL_LARGEST (1L << 27)
#define SUM_LARGEST ((1L << 26) - 1)

static uint8_t too_large(int32_t gain)
{
    return gain > CONTROL_LARGEST || gain < -CONTROL_LARGEST;
}

uint8_t control_refuses(const struct msg_gains *gains)
{
    if (too_large(gains->kp))
        return 2;
    if (too_large(gains->ki))
        return 3;
    if (too_large(gains->kd))
        return 4;
    if (too_large(gains->kc))
        return 6;
    return 0;
}

void control_reset(struct control *control)
{
    if (control->law) {
        law_begin(control->law, &control->state, 0);
    } else {
        control->loop.integral = control->loop.derivative = 0;
        control->loop.begun = 0;
    }
}

static inline int32_t within(int32_t value, int32_t largest)
{
    if (value > largest)
        return largest;
    if (value < -largest)
        return -largest;
    return value;
}

/* Keeps a half of a number from being seen as part of it: else the compiler calls for a product of full length, which
 * takes three times as long. */
#define HALF(x) __asm__("" : "+r"(x))

/* gain * factor, which fits 32 bits. */
static inline int32_t product(int32_t gain, int16_t factor)
{
    return (int16_t)((int16_t)(gain >> 16) * factor) * 65536L + multiply((uint16_t)gain, factor);
}

/* value * fraction / 2^16, to the nearest, without a product of 48 bits. */
static inline int32_t part(int32_t value, uint16_t fraction)
{
    uint16_t lower = (uint16_t)value;
    HALF(lower);
    return multiply(fraction, (int16_t)(value >> 16)) + (int32_t)(((uint32_t)lower * fraction + 0x8000u) >> 16);
}

static inline int32_t filtered(struct control *control, uint16_t position)
{
    struct position_loop *loop = &control->loop;
    int32_t derivative = part(loop->derivative, control->gains.pole);
    if (loop->begun)
        derivative -= product(control->gains.kd, (int16_t)(position - loop->last));
    loop->begun = 1;
    loop->last = position;
    return loop->derivative = within(derivative, DERIVATIVE_LARGEST);
}

void control_begin(struct control *control, uint16_t position)
{
    struct position_loop *loop = &control->loop;
    int16_t error = (int16_t)(control->gains.setpoint - position);
    if (control->law) {
        law_position(&control->state, (int16_t)-error);
        return;
    }
    loop->growth = product(control->gains.ki, error);
    loop->sum = product(control->gains.kp, error) + (loop->integral >> 4) + filtered(control, position);
}

static uint16_t loop_end(struct control *control, int16_t current, int16_t offset, uint16_t low, uint16_t high)
{
    struct position_loop *loop = &control->loop;
    int32_t sum = loop->sum - product(control->gains.kc, current);
    uint16_t fraction; /* of a count, 2^-16 */
    int16_t whole;     /* counts below or at what is wanted */
    uint8_t growing = 1;
    sum = within(sum, SUM_LARGEST) * 16;
    whole = (int16_t)((int16_t)(sum >> 16) + offset);
    fraction = (uint16_t)sum;
    if (whole > (int16_t)high || (whole == (int16_t)high && fraction)) {
        whole = (int16_t)high;
        growing = loop->growth <= 0;
    } else if (whole < (int16_t)low) {
        whole = (int16_t)low;
        growing = loop->growth >= 0;
    } else if (fraction & 0x8000u) {
        whole++;
    }
    if (growing)
        loop->integral = within(loop->integral + loop->growth, INTEGRAL_LARGEST);
    return (uint16_t)whole;
}

uint16_t control_end(struct control *control, uint16_t current, int16_t excitation, uint16_t low, uint16_t high)
{
    int16_t away = (int16_t)(current - control->gains.current_rest);
    int16_t offset = (int16_t)((int16_t)control->gains.duty_bias + excitation);
    if (control->law)
        return law_end(control->law, &control->state, away, offset, low, high);
    return loop_end(control, away, offset, low, high);
}

void control_watch(struct control *control, uint16_t current, uint16_t off, uint8_t last)
{
    control_end(control, current, 0, off, off);
    while (law_ahead(&control->state))
        ;
    if (last)
        law_settled(control->law, &control->state);
}

uint8_t control_ahead(struct control *control)
{
    return control->law ? law_ahead(&control->state) : 0;
}

void control_take(struct control *control, const struct law *law)
{
    int32_t carried = control->law ? law_carried(control->law, &control->state) : control->loop.integral >> 4;
    control->law = law;
    control_reset(control);
    if (law)
        law_begin(law, &control->state, carried);
    else
        control->loop.integral = within(carried, INTEGRAL_LARGEST >> 4) * 16;
}
