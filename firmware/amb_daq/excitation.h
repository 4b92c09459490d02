/*
 * What is added to the pulse width, element by element: square wave, maximum length sequence, table.
 * messages.toml says how each is played.
 */
#ifndef AMB_DAQ_EXCITATION_H
#define AMB_DAQ_EXCITATION_H

#include <stdint.h>

#include "protocol.h"

#define EXCITATION_TABLE 1000 /* elements */

struct excitation {
    uint8_t kind;
    volatile uint8_t playing;
    uint16_t hold, cycles;
    uint16_t elements;    /* of a cycle */
    int16_t amplitude;    /* counts of pulse width */
    uint32_t scale;       /* 2^-16 counts per unit of the table */
    uint16_t start, mask; /* of the shift register */
    uint8_t bits;
    uint16_t shift;       /* register now */
    uint16_t index;       /* element to come */
    uint16_t held;        /* ticks for which the element still holds */
    uint16_t cycles_left;
    int16_t value;
};

/* Returns 0, or the number of the field (from 1, the id is 1) that cannot be played. */
uint8_t excitation_refuses(const struct msg_excitation *wanted);

/* Takes what excitation_refuses did not refuse; not while it plays. */
void excitation_load(struct excitation *e, const struct msg_excitation *wanted);

/* From the beginning, at the next call of excitation_next. */
void excitation_begin(struct excitation *e);

/* One tick: counts to add; 0 when it does not play. */
int16_t excitation_next(struct excitation *e, const int8_t *table);

#endif
