/*
 * The work of one tick.
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* it runs in each tick */
#endif
#include "tick.h"

#include <stddef.h>

#include "daq.h"
#include "safety.h"

static struct sample queue[SAMPLE_QUEUE];
static volatile uint8_t queue_head, queue_tail;
static int16_t prepared; /* excitation of the next tick */

uint8_t tick_begin(uint8_t still_working)
{
    daq.ticks++;
    if (!still_working)
        return 1;
    daq_count(&daq.overruns);
    if (daq_output_on())
        safety_enter(CAUSE_OVERRUN);
    return 0;
}

static uint16_t limited(int16_t duty)
{
    if (duty < (int16_t)daq.limits.duty_low)
        return daq.limits.duty_low;
    if (duty > (int16_t)daq.limits.duty_high)
        return daq.limits.duty_high;
    return (uint16_t)duty;
}

static int16_t bias(void)
{
    return (int16_t)((daq.ready & READY_GAINS) ? daq.control.gains.duty_bias : daq.limits.duty_off);
}

/* Orders the pulse width; a fault that came meanwhile wins. */
static uint16_t order(uint16_t duty)
{
    board_await_order();
    ATOMICALLY
    {
        if (daq_output_on()) {
            board_duty(duty);
            board_output(1);
            if (board_order_late())
                daq_count(&daq.overruns);
        } else {
            duty = daq.limits.duty_off;
        }
    }
    return duty;
}

static void keep(uint16_t tick, uint16_t duty, int16_t excitation)
{
    uint8_t head = queue_head, next = (uint8_t)((head + 1) & (SAMPLE_QUEUE - 1)), stream = daq.stream;
    uint8_t state = daq.state;
    struct sample *sample = &queue[head];
    uint16_t *value = sample->values;
    if (next == queue_tail) {
        daq_count(&daq.dropped);
        return;
    }
    sample->tick = tick;
    sample->state = (uint8_t)(state == STATE_FAULT ? state | (daq.cause << 4) : state);
    if (stream & STREAM_ANALOG_0)
        *value++ = daq.inputs[0];
    if (stream & STREAM_ANALOG_1)
        *value++ = daq.inputs[1];
    if (stream & STREAM_ANALOG_2)
        *value++ = daq.inputs[2];
    if (stream & STREAM_DUTY)
        *value++ = duty;
    if (stream & STREAM_EXCITATION)
        *value++ = (uint16_t)excitation;
    if (stream & STREAM_SETPOINT)
        *value++ = daq.control.gains.setpoint;
    sample->n = (uint8_t)(value - sample->values);
    RING_ORDER();
    queue_head = next;
}

void tick_prepare(void)
{
    prepared = excitation_next(&daq.excitation, daq.table);
}

/* What only needs the position comes first: the current is still being converted. */
static uint16_t law(int16_t *excitation)
{
    uint8_t cause, levitating = daq.state == STATE_LEVITATING;
    uint16_t duty;
    *excitation = prepared;
    if (levitating) {
        if (daq.trial.on)
            trial_tick(daq.inputs[0]);
        control_begin(&daq.control, daq.inputs[0]);
    }
    board_await_input(1);
    cause = safety_check();
    if (cause) {
        safety_enter(cause);
        *excitation = 0;
        return daq.limits.duty_off;
    }
    if (daq.watching) {
        control_watch(&daq.control, daq.inputs[1], daq.limits.duty_off, --daq.watching == 0);
        board_send();
        *excitation = 0;
        return daq.limits.duty_off;
    }
    if (levitating)
        duty = control_end(&daq.control, daq.inputs[1], *excitation, daq.limits.duty_low, daq.limits.duty_high);
    else
        duty = limited((int16_t)(bias() + *excitation));
    if (daq.control.law) /* its states move on, while the order waits and then: bytes to the host wait for them */
        while (board_order_waits() && control_ahead(&daq.control))
            ;
    duty = order(duty);
    if (!daq.control.law)
        board_send(); /* at a fixed time: the line's bytes then never come when the next tick holds its inputs */
    while (control_ahead(&daq.control))
        ;
    tick_prepare();
    return duty;
}

void tick_work(void)
{
    uint16_t tick, duty = daq.limits.duty_off;
    int16_t excitation = 0;
    ATOMICALLY { tick = (uint16_t)(daq.ticks - 1); }
    if (daq_output_on())
        duty = law(&excitation);
    board_await_input(2);
    keep(tick, duty, excitation);
}

const struct sample *tick_sample(void)
{
    uint8_t tail = queue_tail, waits = tail != queue_head;
    RING_ORDER();
    return waits ? &queue[tail] : NULL;
}

void tick_sent(void)
{
    RING_ORDER();
    queue_tail = (uint8_t)((queue_tail + 1) & (SAMPLE_QUEUE - 1));
}
