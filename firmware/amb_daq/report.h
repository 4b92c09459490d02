/*
 * What the controller tells unasked: samples, faults, its status every 256 ticks.
 */
#ifndef AMB_DAQ_REPORT_H
#define AMB_DAQ_REPORT_H

#include <stdint.h>

/* Room in the transmit ring that is kept for the answer to a command. */
#define ANSWER_RESERVE 32

/* Sends what waits. A sample or status that finds no room is dropped and counted; a fault waits for room. */
void report_pending(void);
/* Something waits to be told. */
uint8_t report_waits(void);

/* Puts code and fields of the status at `body`; returns how many bytes. */
uint8_t report_status(uint8_t *body, uint8_t id);

/* The same of the law: which runs, whether on trial, and the last return to the old one. */
uint8_t report_law(uint8_t *body, uint8_t id);

#endif
