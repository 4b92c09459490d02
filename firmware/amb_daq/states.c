/*
 * Changes of state other than faults (safety.h).
 */
#include "states.h"

#include <string.h>

#include "daq.h"
#include "tick.h"

struct daq daq;

void daq_begin(uint8_t by_watchdog)
{
    memset(&daq, 0, sizeof daq);
    daq.cause = by_watchdog ? CAUSE_WATCHDOG : CAUSE_NONE;
    daq.digest = board_digest();
    daq.supply_mv = board_supply_mv();
}

void daq_start(void)
{
    daq.ticks = 0;
    daq.busy_us = 0;
    daq.state = STATE_SAMPLING;
    daq.sampling = 1;
    board_ticks_start(daq.period, (daq.stream & STREAM_ANALOG_2) ? 3 : 2);
}

static uint16_t in_ticks(uint16_t ms)
{
    uint32_t periods = (uint32_t)ms * BOARD_PERIODS_PER_MS;
    return (uint16_t)((periods + daq.period - 1) / daq.period);
}

void daq_output(uint8_t state)
{
    uint16_t host = in_ticks(daq.limits.host_ms), lift = in_ticks(daq.limits.lift_ms);
    uint16_t watching = state == STATE_LEVITATING ? in_ticks(WATCH_MS) : 0;
    ATOMICALLY
    {
        trial_back_out(BACK_OUT_ENDED);
        daq.watching = daq.control.law ? watching : 0;
        if (lift)
            lift = (uint16_t)(lift + daq.watching);
        control_reset(&daq.control);
        daq.excitation.playing = 0;
        tick_prepare();
        daq.host_ticks = host;
        daq.lift_ticks = lift;
        daq.inside = 0;
        daq.silent_ticks = 0;
        daq.state = state;
    }
}

void daq_stop(void)
{
    ATOMICALLY
    {
        board_output(0);
        board_duty(daq.limits.duty_off);
        trial_back_out(BACK_OUT_ENDED);
        daq.excitation.playing = 0;
        daq.sampling = 0;
        if (daq.state != STATE_FAULT)
            daq.state = STATE_IDLE;
    }
    board_ticks_stop();
}
