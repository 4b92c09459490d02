/*
 * The work of one tick: checks, law, pulse width, sample. It runs in the interrupt of the last conversion, with
 * interrupts enabled, so that commands never delay it; the main loop sends the samples.
 */
#ifndef AMB_DAQ_TICK_H
#define AMB_DAQ_TICK_H

#include <stdint.h>

#include "protocol.h"

#define SAMPLE_QUEUE 4 /* a power of two: samples that may wait for the main loop, plus one */

struct sample {
    uint16_t tick;
    uint8_t state; /* with the cause of a fault */
    uint8_t n;
    uint16_t values[STREAM_COLUMNS];
};

/* Begin of a tick, before its conversions. 0: the last tick's work is not done, this one is left out (and counted). */
uint8_t tick_begin(uint8_t still_working);

/* End of it: daq.inputs are converted. */
void tick_work(void);

/* Takes the excitation of the next tick: each tick does it for the one after, as it takes 10 us; also to be called, with
 * no tick in between, when the excitation begins or ends. */
void tick_prepare(void);

/* The oldest sample that waits, or NULL; it stands until tick_sent. */
const struct sample *tick_sample(void);
void tick_sent(void);

#endif
