/*
 * Samples, faults and status on their way to the line.
 */
#include "report.h"

#include <stddef.h>

#include "daq.h"
#include "frame.h"
#include "tick.h"

static uint8_t status_told; /* ticks / 256 at the last unasked status, modulo 256 */

uint8_t report_status(uint8_t *body, uint8_t id)
{
    uint32_t ticks, fault_tick;
    uint16_t overruns, dropped, busy_us;
    uint8_t state, cause;
    ATOMICALLY
    {
        ticks = daq.ticks;
        fault_tick = daq.fault_tick;
        overruns = daq.overruns;
        dropped = daq.dropped;
        busy_us = daq.busy_us;
        state = daq.state;
        cause = daq.cause;
    }
    return write_status(body, id, state, cause, ticks, fault_tick, overruns, dropped, daq.rx_errors,
                        board_rx_lost(), busy_us, daq.supply_mv);
}

static uint16_t ticks_256(void)
{
    uint16_t now;
    ATOMICALLY { now = (uint16_t)(daq.ticks >> 8); }
    return now;
}

static void tell_fault(void)
{
    uint8_t body[LENGTH_FAULT + 2], n;
    RING_ORDER(); /* what a fault leaves stands until it is cleared; it was complete before it was to be told */
    n = write_fault(body, daq.cause, daq.fault_tick, daq.fault_position, daq.fault_current);
    if (frame_put(&board_tx, body, n, 0))
        daq.fault_untold = 0;
}

uint8_t report_law(uint8_t *body, uint8_t id)
{
    uint32_t tick;
    uint16_t position;
    uint8_t running, on, cause;
    ATOMICALLY
    {
        on = daq.trial.on != 0;
        running = daq.control.law || on ? RUNS_LAW : RUNS_GAINS;
        cause = daq.trial.cause;
        tick = daq.trial.tick;
        position = daq.trial.position;
    }
    return write_law_status(body, id, running, on, cause, tick, position);
}

static void tell_back_out(void)
{
    uint8_t body[LENGTH_LAW_STATUS];
    daq.trial.untold = 0;
    if (!frame_put(&board_tx, body, report_law(body, 0), 0))
        daq.trial.untold = 1;
}

static void tell_sample(const struct sample *sample)
{
    uint8_t body[LENGTH_SAMPLE + 2 * STREAM_COLUMNS];
    uint8_t n = write_sample(body, sample->tick, sample->state, sample->values, sample->n);
    if (!frame_put(&board_tx, body, n, ANSWER_RESERVE))
        daq_count(&daq.dropped);
    tick_sent();
}

static void tell_status(void)
{
    uint8_t body[LENGTH_STATUS];
    if (!frame_put(&board_tx, body, report_status(body, 0), ANSWER_RESERVE))
        daq_count(&daq.dropped);
}

void report_pending(void)
{
    const struct sample *sample;
    uint16_t now;
    if (daq.fault_untold)
        tell_fault();
    if (daq.trial.untold)
        tell_back_out();
    while ((sample = tick_sample()) != NULL)
        tell_sample(sample);
    now = ticks_256();
    if ((uint8_t)now != status_told) {
        status_told = (uint8_t)now;
        if (daq.sampling && now)
            tell_status();
    }
    board_send();
}

uint8_t report_waits(void)
{
    return daq.fault_untold || daq.trial.untold || tick_sample() != NULL;
}
