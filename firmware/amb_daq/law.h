/*
 * A discrete state-space law in fixed point, beside the position loop of control.h:
 *
 *   wanted = bias + w + excitation,   w  = C z + D y,   y = (position - setpoint, current - rest)
 *   duty   = limit(wanted),           z+ = A z + B y + G (duty - wanted)
 *
 * A is real and block diagonal, in blocks of two states at most (0 and 1, 2 and 3, 4 and 5), and held as A - 1, so that a
 * slow pole costs no digits. y, wanted and duty are whole counts; |y| <= 1023, e = duty - wanted is limited to +-4095.
 * A state z is held to 30 bits, limited to -2^29 .. 2^29 - 1; what multiplies is its upper part h = z >> 14, 16 bits. It
 * begins with half a step of h (2^13), so that h is the nearest:
 *
 *   W  = sum of c h + d0 32 y0 + d1 32 y1
 *   w  = W >> head.shift, in 2^-12 counts, limited to +-(2^26 - 1) as the position loop's sum is
 *   e  = duty - wanted, wanted to the nearest count
 *   z+ = limit(z + ((self h + other h' + b0 32 y0 + b1 32 y1 + g 8 e) >> shift)),   h' the other one of its block
 *
 * Both >> shift round to the nearest, ties up. Nothing wraps: coefficients are 16-bit words, h, 32 y and 8 e are within
 * +-2^15, and a row whose coefficients' sizes add up to more than 49151 = 1.5 * 2^15 is refused. So a sum is within
 * 2^31 - 2^29 - 2^15, and stays within 2^31 with half a step for the rounding (2^14) and with z added. As 14 bits of z lie below
 * h, an integrator has no dead band: with self = other = 0 it adds up exactly.
 */
#ifndef AMB_DAQ_LAW_H
#define AMB_DAQ_LAW_H

#include <stdint.h>

#define LAW_STATES 6
#define LAW_ROW 49151u

struct law_row {
    int16_t shift, self, other, b0, b1, g, c;
};

/* The words of message `law`, one after the other. */
struct law {
    uint8_t n, shift;
    int16_t d0, d1;
    struct law_row rows[LAW_STATES];
};

#define LAW_WORDS (3 + 7 * LAW_STATES)

struct law_state {
    int32_t z[LAW_STATES];
    int32_t next;      /* C z of the next tick */
    int16_t y0, y1, e; /* of this one: 32 y, 32 y, 8 e */
    uint8_t left;      /* that are to be moved on, from the one at `at`, with the words from `words` on */
    int32_t *at;
    const int16_t *words;
};

/* 1: it could overflow, or is no law. */
uint8_t law_refuses(const struct law *law);

/* The states in which w = carry counts (2^-12) for y = 0: the first pure integrator alone; all zero if there is none. */
void law_begin(const struct law *law, struct law_state *state, int32_t carry);

/* What the pure integrators hold of w, 2^-12 counts. */
int32_t law_carried(const struct law *law, const struct law_state *state);

/* The tick in two steps, as the position is there before the current. The second returns the pulse width: w about
 * `offset`, within low and high. */
static inline void law_position(struct law_state *state, int16_t y) { state->y0 = (int16_t)(y * 32); }
uint16_t law_end(const struct law *law, struct law_state *state, int16_t current, int16_t offset, uint16_t low, uint16_t high);

/* The output goes on with the next tick: pure integrators begin at zero. */
void law_settled(const struct law *law, struct law_state *state);

/* Then the states move on, a block with each call. Returns 0 once all have. */
uint8_t law_ahead(struct law_state *state);

#endif
