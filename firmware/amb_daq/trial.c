/*
 * Trial of a law. The tick changes what runs; the main loop asks for it, and moves only what does not run.
 */
#include "trial.h"

#include <stddef.h>
#include <string.h>

#include "crc16.h"
#include "daq.h"

static struct law own; /* the law that runs, but for one on trial after another law */

void trial_tick(uint16_t position)
{
    struct trial *t = &daq.trial;
    if (t->on == TRIAL_WANTED) {
        t->old = daq.control.law;
        control_take(&daq.control, t->fresh);
        t->on = TRIAL_RUNS;
        t->asked = 0;
        return;
    }
    if (t->asked)
        trial_back_out(BACK_OUT_ASKED);
    else if (position < t->low || position > t->high)
        trial_back_out(BACK_OUT_BOUNDS);
    else if (t->left-- == 0)
        trial_back_out(BACK_OUT_UNCONFIRMED);
}

void trial_back_out(uint8_t cause)
{
    struct trial *t = &daq.trial;
    if (!t->on)
        return;
    if (t->on == TRIAL_RUNS && cause == BACK_OUT_ENDED)
        daq.control.law = t->old; /* the next start resets it */
    else if (t->on == TRIAL_RUNS)
        control_take(&daq.control, t->old);
    t->on = 0;
    t->cause = cause;
    t->tick = daq.ticks - 1;
    t->position = daq.inputs[0];
    t->untold = 1;
}

uint8_t trial_stage(uint8_t offset, const uint8_t *words, uint8_t n)
{
    if (offset > LAW_WORDS - 1)
        return 2;
    if (n == 0 || n > LAW_WORDS - offset)
        return 3;
    memcpy((uint8_t *)&daq.coming + 2 * offset, words, (size_t)(2 * n)); /* little endian, as these machines are */
    if (daq.excitation.kind == KIND_TABLE)
        daq.excitation.kind = KIND_NONE; /* its end is overwritten */
    return 0;
}

static uint16_t checksum(const struct law *law)
{
    const uint8_t *p = (const uint8_t *)law;
    uint8_t left = (uint8_t)(law->n > LAW_STATES ? 0 : 6 + 14 * law->n);
    uint16_t crc = 0;
    while (left--)
        crc = crc16_add(crc, *p++);
    return crc;
}

/* Bounds narrower than the trips, about the set point; a time in which to confirm. */
static uint8_t refuses(const struct msg_arm *wanted)
{
    if (wanted->position_low <= daq.limits.position_low || wanted->position_low >= daq.control.gains.setpoint)
        return 4;
    if (wanted->position_high >= daq.limits.position_high || wanted->position_high <= daq.control.gains.setpoint)
        return 5;
    return wanted->confirm_ms < CONFIRM_MS_LEAST || wanted->confirm_ms > CONFIRM_MS_MOST ? 6 : 0;
}

uint8_t trial_arm(const struct msg_arm *wanted)
{
    uint8_t levitating = daq.state == STATE_LEVITATING, field;
    struct trial *t = &daq.trial;
    if (wanted->period != daq.period)
        return 2;
    if (wanted->checksum != checksum(&daq.coming))
        return 3;
    if (law_refuses(&daq.coming) || daq.coming.n > LAW_MOST(daq.period))
        return 1;
    if (levitating && (field = refuses(wanted)) != 0)
        return field;
    if (!levitating) {
        if (wanted->confirm_ms)
            return 6;
        own = daq.coming;
        daq.control.law = &own;
        return 0;
    }
    t->fresh = &daq.coming;
    if (daq.control.law == NULL) {
        own = daq.coming;
        t->fresh = &own;
    }
    t->low = wanted->position_low;
    t->high = wanted->position_high;
    t->left = (uint16_t)((uint32_t)wanted->confirm_ms * BOARD_PERIODS_PER_MS / daq.period);
    t->cause = BACK_OUT_NONE;
    ATOMICALLY { t->on = TRIAL_WANTED; }
    return 0;
}

uint8_t trial_confirm(void)
{
    uint8_t on;
    ATOMICALLY
    {
        on = daq.trial.on == TRIAL_RUNS;
        if (on)
            daq.trial.on = 0;
    }
    if (on && daq.control.law == &daq.coming) {
        own = daq.coming; /* the law that was in it is given up */
        ATOMICALLY { daq.control.law = &own; }
    }
    return on;
}

uint16_t trial_table(void)
{
    return daq.trial.on && daq.trial.fresh == &daq.coming ? (uint16_t)(EXCITATION_TABLE - LAW_TABLE) : EXCITATION_TABLE;
}
