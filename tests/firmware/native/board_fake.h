/*
 * What a test sets and sees of the board.
 */
#ifndef BOARD_FAKE_H
#define BOARD_FAKE_H

#include <stdint.h>

struct fake {
    uint8_t output, ticking, inputs, interlock_open, line_broken, pwm_broken, order_late, order_waits, by_watchdog;
    uint16_t duty, highest_duty, period, supply_mv, digest, free_bytes;
    uint16_t analog[3];
};

extern struct fake fake;

#endif
