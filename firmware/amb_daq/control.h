/*
 * The position loop in fixed point: the law of src/ambid/physics/loop.py in counts.
 *
 *   duty = limit(bias + kp e + I + D - kc (i - rest) + excitation),  e = setpoint - x
 *   I of the next tick = I + ki e, but while the duty is limited I only moves back (anti-windup)
 *   D = pole * D of the last tick - kd (x - x of the last tick)
 *
 * x, i: 10-bit counts. kp, kd, kc, D: 2^-12 counts of pulse width; ki, I: 2^-16; pole: 2^-16. The sum is made in 2^-12
 * and rounded to the nearest count once, at the end.
 *
 * Nothing can overflow 32 bits: |gain| <= CONTROL_LARGEST = 2^19 (128 counts per count; ki: 8 per count and tick), so a
 * product with a difference of two inputs (|.| <= 1023) is below 2^29; D is limited to +-2^28 and I to +-2^27 (2048
 * counts), so their sum stays below 2^29 + 2^23 + 2^28 + 2^29 < 2^31. It is limited to +-2^26 (16384 counts of pulse
 * width, twenty times its range) before bias and excitation are added. Larger gains are refused.
 *
 * Instead of it a state-space law may run (law.h). One takes over from the other between two ticks, without a jump of what
 * holds the rotor: the integral of the one that ran is that of the one that begins, whose other states begin at zero.
 */
#ifndef AMB_DAQ_CONTROL_H
#define AMB_DAQ_CONTROL_H

#include <stdint.h>

#include "law.h"
#include "protocol.h"

#define CONTROL_LARGEST (1L << 19)

struct position_loop {
    int32_t integral;    /* 2^-16 counts */
    int32_t derivative;  /* 2^-12 counts */
    uint16_t last;       /* position of the last tick */
    uint8_t begun;       /* there was a last tick */
    int32_t growth, sum; /* of this tick: what the integral would grow by; what the position alone asks for, 2^-12 */
};

struct control {
    struct msg_gains gains; /* set point, rest and bias hold for a law too */
    const struct law *law;  /* NULL: the gains */
    union {
        struct position_loop loop;
        struct law_state state;
    };
};

/* Returns 0, or the number of the field (from 1, the id is 1) of a gain that could overflow. */
uint8_t control_refuses(const struct msg_gains *gains);

/* Forgets integral, derivative and states. */
void control_reset(struct control *control);

/* One tick, in two steps, as the position is there before the current. The second returns the pulse width, within low and
 * high; nothing changes the gains between them. */
void control_begin(struct control *control, uint16_t position);
uint16_t control_end(struct control *control, uint16_t current, int16_t excitation, uint16_t low, uint16_t high);

/* In place of control_end, before a law's output goes on: the pulse width is `off`, whatever it wants; `last`: the output goes
 * on with the next tick. */
void control_watch(struct control *control, uint16_t current, uint16_t off, uint8_t last);

/* What is left of the tick's work, some 35 us with each call; 0: nothing. All must be done before the next tick. */
uint8_t control_ahead(struct control *control);

/* Lets a law run, or the gains (NULL), from the next control_begin on. */
void control_take(struct control *control, const struct law *law);

#endif
