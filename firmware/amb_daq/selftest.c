/*
 * The self-test. The program memory is compared with its digest at reset, which identify tells the host too.
 */
#include "selftest.h"

#include "daq.h"

#define SUPPLY_LEAST 4500
#define SUPPLY_MOST 5500
#define FREE_LEAST 48 /* bytes below the deepest stack so far */
#define READINGS 16
#define STILL 32 /* counts: readings of a current at rest lie no farther apart */

struct reading {
    uint16_t least, most, mean;
};

static struct reading read(uint8_t input)
{
    struct reading r = {BOARD_ADC_TOP, 0, 0};
    uint8_t i;
    for (i = 0; i < READINGS; i++) {
        uint16_t value = board_measure(input);
        r.mean = (uint16_t)(r.mean + value);
        if (value < r.least)
            r.least = value;
        if (value > r.most)
            r.most = value;
    }
    r.mean = (uint16_t)((r.mean + READINGS / 2) / READINGS);
    return r;
}

uint16_t selftest_fatal(void)
{
    uint16_t failed = 0;
    if (board_digest() != daq.digest)
        failed |= FAILED_PROGRAM;
    if (board_free_bytes() < FREE_LEAST || !board_memory_sound())
        failed |= FAILED_MEMORY;
    if (!board_pwm_sound())
        failed |= FAILED_PULSE_WIDTH;
    return failed;
}

/* Without output the current must be still, and within its limits where these are known. */
static uint8_t current_wrong(const struct reading *current)
{
    if (current->most - current->least > STILL)
        return 1;
    return (daq.ready & READY_LIMITS) &&
           (current->mean < daq.limits.current_low || current->mean > daq.limits.current_high);
}

void selftest_run(struct msg_self_test_result *result)
{
    struct reading position, current;
    result->failed = selftest_fatal();
    board_duty(daq.limits.duty_off);
    result->supply_mv = daq.supply_mv = board_supply_mv();
    result->free_bytes = board_free_bytes();
    position = read(0);
    current = read(1);
    result->position = position.mean;
    result->current = current.mean;
    if (daq.supply_mv < SUPPLY_LEAST || daq.supply_mv > SUPPLY_MOST)
        result->failed |= FAILED_SUPPLY;
    if (position.mean == 0 || position.mean == BOARD_ADC_TOP)
        result->failed |= FAILED_POSITION;
    if (current_wrong(&current))
        result->failed |= FAILED_CURRENT;
    if (board_interlock_open())
        result->failed |= FAILED_INTERLOCK;
}
