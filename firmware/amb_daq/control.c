/*
 * The position loop. Right shifts of negative numbers are arithmetic, as in every compiler for these machines. Shifts of
 * 32 bits are by 4 or 16 only: the processor shifts by one bit at a time, but moves whole bytes.
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* also where the Arduino IDE asks for small code: it runs in each tick */
#endif
#include "control.h"

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
    control->integral = control->derivative = 0;
    control->begun = 0;
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
    int16_t upper = (int16_t)((int16_t)(gain >> 16) * factor);
    uint16_t lower = (uint16_t)gain;
    HALF(lower);
    return upper * 65536L + (int32_t)lower * factor;
}

/* value * fraction / 2^16, to the nearest, without a product of 48 bits. */
static inline int32_t part(int32_t value, uint16_t fraction)
{
    int16_t upper = (int16_t)(value >> 16);
    uint16_t lower = (uint16_t)value;
    HALF(upper);
    HALF(lower);
    return (int32_t)upper * fraction + (int32_t)(((uint32_t)lower * fraction + 0x8000u) >> 16);
}

static inline int32_t filtered(struct control *control, uint16_t position)
{
    int32_t derivative = part(control->derivative, control->gains.pole);
    if (control->begun)
        derivative -= product(control->gains.kd, (int16_t)(position - control->last));
    control->begun = 1;
    control->last = position;
    return control->derivative = within(derivative, DERIVATIVE_LARGEST);
}

void control_begin(struct control *control, uint16_t position)
{
    int16_t error = (int16_t)(control->gains.setpoint - position);
    control->growth = product(control->gains.ki, error);
    control->sum = product(control->gains.kp, error) + (control->integral >> 4) + filtered(control, position);
}

uint16_t control_end(struct control *control, uint16_t current, int16_t excitation, uint16_t low, uint16_t high)
{
    int32_t sum = control->sum - product(control->gains.kc, (int16_t)(current - control->gains.current_rest));
    uint16_t fraction; /* of a count, 2^-16 */
    int16_t whole;     /* counts below or at what is wanted */
    uint8_t growing = 1;
    sum = within(sum, SUM_LARGEST) * 16;
    whole = (int16_t)((int16_t)(sum >> 16) + (int16_t)control->gains.duty_bias + excitation);
    fraction = (uint16_t)sum;
    if (whole > (int16_t)high || (whole == (int16_t)high && fraction)) {
        whole = (int16_t)high;
        growing = control->growth <= 0;
    } else if (whole < (int16_t)low) {
        whole = (int16_t)low;
        growing = control->growth >= 0;
    } else if (fraction & 0x8000u) {
        whole++;
    }
    if (growing)
        control->integral = within(control->integral + control->growth, INTEGRAL_LARGEST);
    return (uint16_t)whole;
}
