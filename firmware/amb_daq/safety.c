/*
 * Checks of each tick and the way into and out of the safe state. The lines (interlock, cable) are watched by the
 * timer's interrupt in board_timers.c, more often than ticks come.
 */
#include "safety.h"

#include "daq.h"
#include "selftest.h"

void safety_enter(uint8_t cause)
{
    ATOMICALLY
    {
        if (daq.state != STATE_FAULT) {
            board_output(0);
            board_duty(daq.limits.duty_off);
            daq.state = STATE_FAULT;
            daq.cause = cause;
            daq.excitation.playing = 0;
            daq.fault_tick = daq.ticks ? daq.ticks - 1 : 0;
            daq.fault_position = daq.inputs[0];
            daq.fault_current = daq.inputs[1];
            daq.fault_untold = 1;
        }
    }
}

static uint8_t current_outside(uint16_t current)
{
    return current < daq.limits.current_low || current > daq.limits.current_high;
}

static inline uint8_t position_outside(uint16_t position)
{
    return position < daq.limits.position_low || position > daq.limits.position_high;
}

/* A tick in which the position does not count yet. */
static inline void lift(uint8_t outside)
{
    daq.lift_ticks--;
    daq.inside = outside ? 0 : (uint16_t)(daq.inside + daq.period);
    if (daq.inside >= LIFTED_MS * BOARD_PERIODS_PER_MS)
        daq.lift_ticks = 0;
}

uint8_t safety_check(void)
{
    uint16_t position = daq.inputs[0];
    if (current_outside(daq.inputs[1]))
        return CAUSE_OVER_CURRENT;
    if (daq.lift_ticks)
        lift(position_outside(position));
    else if (position_outside(position))
        return CAUSE_OUT_OF_GAP;
    if (daq.silent_ticks >= daq.host_ticks)
        return CAUSE_HOST_SILENT;
    daq.silent_ticks++;
    return CAUSE_NONE;
}

static uint16_t current_now(void)
{
    uint16_t current;
    if (!daq.sampling)
        return board_measure(1);
    ATOMICALLY { current = daq.inputs[1]; }
    return current;
}

/* A host that asks is not silent, and a rotor without current lies where it lies: those causes end with the fault. */
uint8_t safety_clears(void)
{
    switch (daq.cause) {
    case CAUSE_INTERLOCK:
        return board_interlock_open() ? CODE_INTERLOCK : CODE_DONE;
    case CAUSE_LINE_BREAK:
        return board_line_broken() ? CODE_STATE : CODE_DONE;
    case CAUSE_OVER_CURRENT:
        return current_outside(current_now()) ? CODE_STATE : CODE_DONE;
    case CAUSE_SELF_TEST:
        return selftest_fatal() ? CODE_STATE : CODE_DONE;
    default:
        return CODE_DONE;
    }
}
