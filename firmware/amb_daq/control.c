/*
 * The position loop. Right shifts of negative numbers are arithmetic, as in every compiler for these machines.
 */
#include "control.h"

#define TERM_LARGEST (1L << 28)
#define INTEGRAL_LARGEST (1L << 27)

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

static int32_t within(int32_t value, int32_t largest)
{
    if (value > largest)
        return largest;
    if (value < -largest)
        return -largest;
    return value;
}

/* value * fraction / 2^16, to the nearest, without a product of 48 bits. */
static int32_t part(int32_t value, uint16_t fraction)
{
    int32_t upper = (int32_t)(int16_t)(value >> 16) * fraction;
    uint32_t lower = (uint32_t)(uint16_t)value * fraction + 0x8000u;
    return upper + (int32_t)(lower >> 16);
}

static int32_t filtered(struct control *control, const struct msg_gains *gains, uint16_t position)
{
    int32_t derivative = part(control->derivative, gains->pole);
    if (control->begun)
        derivative -= gains->kd * (int16_t)(position - control->last);
    control->begun = 1;
    control->last = position;
    return control->derivative = within(derivative, TERM_LARGEST);
}

uint16_t control_step(struct control *control, const struct msg_gains *gains, uint16_t position, uint16_t current,
                      int16_t excitation, uint16_t low, uint16_t high)
{
    int16_t error = (int16_t)(gains->setpoint - position);
    int32_t growth = gains->ki * error;
    int32_t wanted = (int32_t)((int16_t)gains->duty_bias + excitation) * 4096;
    int8_t beyond = 0;
    uint16_t duty;
    wanted += within(gains->kp * error, TERM_LARGEST) + (control->integral >> 4);
    wanted += filtered(control, gains, position);
    wanted -= within(gains->kc * (int16_t)(current - gains->current_rest), TERM_LARGEST);
    if (wanted > (int32_t)high * 4096) {
        duty = high;
        beyond = 1;
    } else if (wanted < (int32_t)low * 4096) {
        duty = low;
        beyond = -1;
    } else {
        duty = (uint16_t)((wanted + 2048) >> 12);
    }
    if (!(beyond > 0 && growth > 0) && !(beyond < 0 && growth < 0))
        control->integral = within(control->integral + growth, INTEGRAL_LARGEST);
    return duty;
}
