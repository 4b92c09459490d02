/*
 * A law on trial: the one that ran before stays stored, and takes over again, within the same tick, where the rotor leaves the
 * bounds that came with the new one or the host does not confirm it in time.
 *
 * There is memory for one law of its own. Words of a new one come into the end of the excitation's table. If no law ran
 * before, it moves to its own place as it is armed; else it runs where it is until it is confirmed, and the table is
 * shorter by LAW_TABLE meanwhile.
 */
#ifndef AMB_DAQ_TRIAL_H
#define AMB_DAQ_TRIAL_H

#include <stdint.h>

#include "excitation.h"
#include "law.h"
#include "protocol.h"

#define LAW_TABLE sizeof(struct law)

enum { TRIAL_WANTED = 1, TRIAL_RUNS };

struct trial {
    volatile uint8_t on;         /* TRIAL_WANTED, then TRIAL_RUNS; 0: there is none */
    volatile uint8_t asked;      /* the host wants the old law again */
    volatile uint8_t cause;      /* of the last return to the old law */
    volatile uint8_t untold;     /* that return is still to be told */
    uint16_t low, high;          /* bounds of the position */
    volatile uint16_t left;      /* ticks until it must be confirmed */
    uint32_t tick;               /* of that return */
    uint16_t position;           /* then */
    const struct law *old, *fresh;
};

/* Begin of a tick's law, while levitating. */
void trial_tick(uint16_t position);

/* Ends a trial, if there is one: the old law stands again. */
void trial_back_out(uint8_t cause);

/* Words of a law that comes; the field that is refused, 0 for none. */
uint8_t trial_stage(uint8_t offset, const uint8_t *words, uint8_t n);

/* What came is whole (checksum), of this rate and within bounds: it is taken. Returns the field that is refused, 0 for none. */
uint8_t trial_arm(const struct msg_arm *wanted);

/* The law on trial stays; 0: there is none. */
uint8_t trial_confirm(void);

/* Elements of the excitation's table that are free for it now. */
uint16_t trial_table(void);

#endif
